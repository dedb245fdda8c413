"""What a user names becomes a value: files, float networks, recordings."""
