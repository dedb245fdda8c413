"""Where float network and chip break."""
