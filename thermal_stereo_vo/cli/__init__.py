"""The verbs of the command line: they parse, the rooms do the work."""
