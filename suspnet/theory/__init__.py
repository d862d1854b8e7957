"""Fisher information and Cramer-Rao bounds of curves, features and sensors."""
