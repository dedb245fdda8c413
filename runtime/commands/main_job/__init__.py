"""Commands of the main job: compile, run, verify, estimate, report."""
