"""Trains: from recordings to a suspension that wears, its history and its maintenance."""
