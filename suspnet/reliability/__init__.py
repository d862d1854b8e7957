"""How far an estimate can be trusted: refinement on the curve, intervals, what is out of range."""
