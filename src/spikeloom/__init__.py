"""Lower a trained spiking graph network for touch to an integer netlist, run it bit for bit and price it."""

__version__ = "0.1.0"
