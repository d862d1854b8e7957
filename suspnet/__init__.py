"""Stiffness and damping of train suspensions from three vertical accelerometers."""

__version__ = "0.1.0"
