"""Web pages that show a fleet while trips come in: ``python -m suspnet.serve``."""
