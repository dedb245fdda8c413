"""NIR files: reader and writer."""

CONVENTIONS = ("euler", "exponential")
"""What a step keeps of a time constant, by default the first."""
