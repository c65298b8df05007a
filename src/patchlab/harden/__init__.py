"""Assistive images: photographs changed so that networks recognize them better, also when attacked."""
