"""Many measurements side by side."""
