"""Look into a history, add maintenance, write tables: python -m suspnet.history STORE ..."""

from suspnet.cli.history import main

if __name__ == "__main__":
    main()
