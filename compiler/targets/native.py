"""Networks that are trained in whole numbers for a chip: what such a system is called, and what its inputs may be."""

from spikeloom.compiler.targets.truenorth.native import BASES, DEFAULT_COPIES, SYSTEM

__all__ = ["BASES", "DEFAULT_COPIES", "SYSTEM"]
