"""What the passes of every chip share; their order stands in each target's ``PASSES``."""
