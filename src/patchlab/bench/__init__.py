"""Benchmarks: speed against accuracy of every setting."""
