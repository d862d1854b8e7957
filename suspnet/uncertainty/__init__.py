"""How far an estimate can be trusted: refinement, intervals, out-of-distribution detection."""
