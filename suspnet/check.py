"""Check manifests and recordings without a model: python -m suspnet.check DIR ..."""

from suspnet.cli.check import main

if __name__ == "__main__":
    main()
