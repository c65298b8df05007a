"""Training of the built-in networks, and of others on the same pictures."""
