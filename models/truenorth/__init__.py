"""Networks that are trained for TrueNorth: everything that the chip rounds or limits is rounded and limited in training."""
