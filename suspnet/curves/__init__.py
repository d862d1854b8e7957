"""Module 2 of the paper: noisy responses as the methods see them, features, and the tasks."""
