"""Prints and their photographs in simulation: our own renderer, one that is not ours, and charts."""
