"""From frequency responses to stiffness and damping: problem, model, intervals."""
