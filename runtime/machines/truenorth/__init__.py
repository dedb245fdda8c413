"""IBM TrueNorth, tick by tick."""
