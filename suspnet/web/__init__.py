"""The fleet as pages that a browser shows while trips come in: ``python -m suspnet.serve``."""
