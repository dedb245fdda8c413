"""Readers of other people's files; each returns plain values, nothing here runs foreign code."""
