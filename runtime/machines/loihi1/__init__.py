"""Loihi 1: its definition, the fast engine equal to it, and its prices."""
