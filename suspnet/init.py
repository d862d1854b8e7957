"""Write a template of a manifest from data files: python -m suspnet.init FILE ..."""

from suspnet.cli.init import main

if __name__ == "__main__":
    main()
