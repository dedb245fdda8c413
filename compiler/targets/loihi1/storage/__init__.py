"""How weights become integers: widths, scales and planes."""
