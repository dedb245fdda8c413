"""How many changed events a decision bears at least, and which alter it."""
