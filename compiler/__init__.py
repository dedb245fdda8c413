"""Checkpoint to network to integer netlist; imports nothing of ours outside this package."""

__version__ = "0.1.0"
