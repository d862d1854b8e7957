"""Replay recorded trips as frames of live samples: python -m suspnet.replay trips=DIR ..."""

from suspnet.cli.start import replay

if __name__ == "__main__":
    replay()
