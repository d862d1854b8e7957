"""Train one method on one problem, or many by a multirun: python train.py --help."""

from suspnet.cli.train import main

if __name__ == "__main__":
    main()
