"""Commands that ask where a network breaks and why."""
