"""What of a scene is modeled, what is not, and why."""
