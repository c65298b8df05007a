"""The verbs of the command line: each combines other rooms into one command."""
