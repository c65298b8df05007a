"""The verbs: each joins rooms into one command, with no logic of its own below it."""
