"""What was simulated and why, and the yardsticks of others; prices stand with each machine."""
