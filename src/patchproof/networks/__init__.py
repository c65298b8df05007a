"""Files of networks read without executing anything in them, and forms of a network that compute faster."""
