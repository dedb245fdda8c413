"""The smallest network that does a job, chosen by cross-validation."""
