"""What becomes of the chip where something else is true: an event, what it stores, how it rounds."""
