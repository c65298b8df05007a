"""A run's pages: its sheet and those of its controls, and the plan of where it goes and what to photograph."""
