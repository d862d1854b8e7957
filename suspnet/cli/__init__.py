"""Command line: train, evaluate and simulate as functions, and what they share."""
