"""What is typed: a module for each command, in the folder of its group, with ``add_arguments`` and ``run``."""
