"""What a user may ask: one frozen request a question; command lines and Python functions derive from it."""
