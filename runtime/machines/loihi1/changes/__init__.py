"""What a changed event brings about on the chip, beside a run that is known."""
