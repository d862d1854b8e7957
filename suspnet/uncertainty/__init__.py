"""Trust in estimates: refinement, prediction intervals, out-of-distribution detection."""
