"""Simulate photographs of a run's page on its object, and of pages lying flat."""
