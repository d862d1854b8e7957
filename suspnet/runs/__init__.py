"""Training runs and studies: fit, calibrate, predict, score, and what a run folder holds."""
