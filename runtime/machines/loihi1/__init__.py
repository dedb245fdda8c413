"""Loihi 1, step by step."""
