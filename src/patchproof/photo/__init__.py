"""Photographs of a sheet: read them upright, find its markers, and turn pixels into millimeters. Needs no torch."""
