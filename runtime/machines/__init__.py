"""Simulated chips: a definition and a fast engine each."""
