"""Training runs and studies: fit, calibrate, predict, score, and the files of a run folder."""
