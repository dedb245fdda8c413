"""Intel Loihi 1: integers, cores, netlist."""
