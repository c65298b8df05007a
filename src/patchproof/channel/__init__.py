"""What the world does to colors: printer, light and camera, differentiable where optimizing needs it."""
