"""What chart, smallest and lean share: candidates are measured, those on the front are shown, one is chosen."""
