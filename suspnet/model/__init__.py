"""A fitted model: its parts, its files, and what it estimates from curves and recordings."""
