"""Whole experiments: simulated reprints, the demo, and how the built-in network was trained."""
