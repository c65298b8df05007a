"""Errors, strict settings, rates and sessions, color, geometry, files and workers: what every room stands on."""
