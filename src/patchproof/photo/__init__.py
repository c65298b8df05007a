"""Photographs of a sheet: read them upright, find its markers, and turn pixels into millimetres. Needs no torch."""
