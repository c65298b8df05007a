"""A run's page, hung on the object and photographed in simulation: our renderer, one that is not ours, and charts."""
