"""lava-dl's ``.net`` files: reader and writer."""
