"""Every published figure: its config, its stored data, and the program that made it where no study does."""
