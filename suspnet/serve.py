"""Show a fleet's history in the browser: python -m suspnet.serve store=FILE [KEY=VALUE ...]."""

from suspnet.cli.start import serve

if __name__ == "__main__":
    serve()
