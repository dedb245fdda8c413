"""Checkpoint to network to integer netlist; imports nothing of ours outside this package."""
