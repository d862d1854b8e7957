"""Score trained models on fresh curves, or read trips with them: python evaluate.py --help."""

from suspnet.cli.evaluate import main

if __name__ == "__main__":
    main()
