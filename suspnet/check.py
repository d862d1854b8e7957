"""Check manifests and recordings without a model: python -m suspnet.check DIR ..."""

from suspnet.cli.start import check

if __name__ == "__main__":
    check()
