"""List, export and annotate a store of the history: python -m suspnet.history STORE ..."""

from suspnet.cli.start import history

if __name__ == "__main__":
    history()
