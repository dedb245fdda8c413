"""NIR files: reader and writer."""
