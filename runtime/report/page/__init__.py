"""The page of ``report``."""
