"""Networks trained for TrueNorth: whatever the chip rounds or limits is rounded and limited in training."""
