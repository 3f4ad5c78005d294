"""`python -m halfspace_sss` is the command `halfspace-sss`."""

from halfspace_sss.cli import main

if __name__ == "__main__":
    main()
