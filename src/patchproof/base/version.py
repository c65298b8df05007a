"""The version, as the package, a run and a verification's journal state it."""

__version__ = "0.1.0"
