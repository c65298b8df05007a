"""Read files of networks without executing anything in them, and call networks in the fastest batches."""
