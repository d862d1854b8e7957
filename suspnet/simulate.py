"""Write an example fleet whose truth is known: python -m suspnet.simulate [KEY=VALUE ...]."""

from suspnet.cli.start import simulate

if __name__ == "__main__":
    simulate()
