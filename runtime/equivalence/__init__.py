"""Float model against chip: how equal they are, and why not."""
