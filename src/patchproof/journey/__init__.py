"""Verification of photographs, and the demo that goes the whole way."""
