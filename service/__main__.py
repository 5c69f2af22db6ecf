"""``python -m service``: as ``splatlift serve``."""

import sys

from liftcore.cli import main

if __name__ == "__main__":
    sys.exit(main(["serve", *sys.argv[1:]]))
