"""What of a network its recordings do not need."""
