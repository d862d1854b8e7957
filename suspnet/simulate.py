"""Write an example fleet whose truth is known: python -m suspnet.simulate [KEY=VALUE ...]."""

from suspnet.cli.simulate import main

if __name__ == "__main__":
    main()
