"""The operating envelope of a run's patch: where each stage stops working."""
