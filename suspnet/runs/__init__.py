"""One run: fit, calibrate, predict, score, and what a run folder holds."""
