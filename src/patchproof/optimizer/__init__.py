"""From a scene to a design and a promise: goals, the loop, and the run that stores them."""
