"""The plan of a scene: its geometry, the error of each term of the model, sample sizes, and the cost of a step."""
