"""Estimate from live frames, store the results: python -m suspnet.monitor [KEY=VALUE ...]."""

from suspnet.cli.start import monitor

if __name__ == "__main__":
    monitor()
