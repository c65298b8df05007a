"""A scene file to begin with, and a look at it before anything is optimized."""
