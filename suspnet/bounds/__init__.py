"""What can be known: Fisher information of curves, features and recordings, Cramer-Rao bounds."""
