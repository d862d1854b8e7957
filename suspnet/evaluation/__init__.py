"""Scores, limits and comparisons."""
