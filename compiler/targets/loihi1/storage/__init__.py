"""How weights become integers: widths, scales, planes, and the proof that nothing overflows."""
