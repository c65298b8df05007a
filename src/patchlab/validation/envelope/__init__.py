"""Where each stage of one run's patch stops working."""
