"""The command suspnet without its installed script: python -m suspnet PROGRAM ..."""

from suspnet.cli.command import main

if __name__ == "__main__":
    main()
