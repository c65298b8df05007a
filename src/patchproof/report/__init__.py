"""The report of a verification: JSON for programs, one self-contained page for people."""
