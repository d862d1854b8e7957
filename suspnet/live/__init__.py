"""Live monitoring: sources of frames, what is done with them, and the replay of recorded trips."""
