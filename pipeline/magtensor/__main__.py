"""`python -m magtensor`."""

from magtensor.cli import main

if __name__ == "__main__":
    main()
