"""IBM TrueNorth: cores with a binary crossbar, one type to an axon, one target to a neuron."""
