"""Hostile files: `readers` breaks honest ones for every reader, `hostile` builds what does harm on purpose."""
