"""`python -m sattools`."""

from sattools.cli import entry

if __name__ == "__main__":
    entry()
