"""How the built-in network was made."""
