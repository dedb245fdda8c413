"""What a run costs: events times price tables, and times."""
