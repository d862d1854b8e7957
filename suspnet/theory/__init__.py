"""What can be known at best: Fisher information, Cramer-Rao bounds, what a sensor would buy."""
