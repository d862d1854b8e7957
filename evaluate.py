"""Score trained models on fresh curves, or read trips with them: python evaluate.py --help."""

from suspnet.cli.start import evaluate

if __name__ == "__main__":
    evaluate()
