"""Which decisions no small change of a recording alters, and which change alters the others: proven, not sampled."""
