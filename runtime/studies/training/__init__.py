"""Networks are trained, fine-tuned and joined."""
