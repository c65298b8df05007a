"""Make pictures of a scene under drawn conditions: rasterize, sample textures, shade, photograph."""
