"""Spiking networks as torch modules."""
