"""One file per pass; the order lives in each target's ``PASSES``."""
