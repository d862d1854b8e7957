"""Training runs and sweeps of the paper: fit, calibrate, predict, score; files of a run folder."""
