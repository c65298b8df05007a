"""The harness of studies: cells that resume and spread, and what trained designs share."""
