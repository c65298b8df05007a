"""The verbs `new` and `preview`: write a scene file, and show its scene before anything is optimized."""
