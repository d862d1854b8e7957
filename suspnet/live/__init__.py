"""Live monitoring: sources of frames, how they are processed, and the replay of recorded trips."""
