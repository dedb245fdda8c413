"""Which neuron sits on which core, and which core on which tile."""
