"""What a network bears: perturbations that are drawn by chance, and small ones that are all decided."""
