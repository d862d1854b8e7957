"""What is asked of vehicles and models before they are relied on, by evaluate.py."""
