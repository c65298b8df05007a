"""The effects of printer, light and camera on colors, differentiable where optimizing needs it."""
