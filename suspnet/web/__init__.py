"""Web pages that show a fleet while trips come in: ``suspnet serve``."""
