"""`python -m physjax` is the command `physjax`."""

import sys

from physjax.cli import main

if __name__ == "__main__":
    sys.exit(main())
