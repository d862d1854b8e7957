"""The programs as functions, and what they share."""
