"""How many votes changed events turn at most, in any arithmetic that follows its bounds."""
