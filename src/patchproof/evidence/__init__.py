"""The judge: photographs of a print against the promise in its manifest. Knows nothing of how the design was made."""
