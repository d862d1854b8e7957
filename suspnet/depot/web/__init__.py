"""The fleet as pages and as a JSON API while trips come in."""
