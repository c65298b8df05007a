"""Photographs from a phone's browser into a folder, each answered at once."""
