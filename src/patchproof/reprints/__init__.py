"""Simulate photographs of a run's page on its object, by our renderer or by path tracing, and of pages lying flat."""
