"""Photographs of a sheet: read them upright, find its markers, and map pixels to millimeters. Needs no torch."""
