"""Accuracy against cost, over many configurations."""
