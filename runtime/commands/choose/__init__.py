"""Commands that choose what to deploy."""
