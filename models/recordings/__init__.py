"""Recordings of touch: read, written, described, made."""
