"""From a scene and drawn conditions to pictures: rasterize, sample textures, shade, photograph."""
