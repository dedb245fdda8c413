"""The float world: tactile graphs, recordings, networks and training; may import the compiler."""
