"""Studies of vehicles and models: identifiability, reliability, ablations."""
