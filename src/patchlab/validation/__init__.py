"""Studies of the tool: do its statements hold, and where does it stop working?"""
