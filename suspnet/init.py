"""Write a template of a manifest from data files: python -m suspnet.init FILE ..."""

from suspnet.cli.start import init

if __name__ == "__main__":
    init()
