"""From frequency responses to stiffness and damping: methods fitted, intervals, model files."""
