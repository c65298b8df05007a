"""The README's three charts: speed against accuracy, where methods break, and the worth of each term of the model."""
