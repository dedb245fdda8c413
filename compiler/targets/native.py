"""Networks that are trained in whole numbers for a chip: what such a system is called, and what its inputs may be."""

from spikeloom.compiler.targets.truenorth.native import BASES, SYSTEM, USUAL_COPIES

__all__ = ["BASES", "SYSTEM", "USUAL_COPIES"]
