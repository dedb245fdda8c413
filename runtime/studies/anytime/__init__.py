"""How early a decision is sure."""
