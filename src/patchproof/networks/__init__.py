"""Read files of networks without executing anything in them, and rewrite networks so that they compute faster."""
