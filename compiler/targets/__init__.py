"""Chips: their limits and prices, and the passes that lower a network to each."""

DEFAULT_TARGET = "loihi1"
