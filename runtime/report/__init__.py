"""Results as sections, and their renderers."""
