"""Measure and judge photographs of a print against the promise in its manifest, whatever made the design."""
