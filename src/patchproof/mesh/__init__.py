"""Meshes: read from files or made, and unwrapped where they lack texture coordinates."""
