"""`python -m sattools`."""

from sattools.cli import main

if __name__ == "__main__":
    main(prog_name="sattools")
