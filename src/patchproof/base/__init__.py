"""Errors, validated settings, intervals and sessions, color, geometry, files, workers: every room imports from here."""
