"""Read frames as they come, and keep what they show: python -m suspnet.monitor [KEY=VALUE ...]."""

from suspnet.cli.start import monitor

if __name__ == "__main__":
    monitor()
