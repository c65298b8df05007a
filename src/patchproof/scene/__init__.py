"""Scenes to photograph: the object, the place of the piece on it, and the conditions of the views."""
