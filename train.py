"""Train one method on one problem, or many by a multirun: python train.py --help."""

from suspnet.cli.start import train

if __name__ == "__main__":
    train()
