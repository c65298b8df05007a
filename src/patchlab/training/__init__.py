"""How the built-in networks were made, and others on the same pictures."""
