"""``python -m liftcore.cli``: as ``splatlift``."""

import gc
import sys
from typing import NoReturn

from liftcore.cli import main


def run() -> NoReturn:
    """Run a command as the whole of a process, and end it."""
    # A command lives for seconds, and torch makes many objects: to look through them for cycles at each 700 new ones
    # takes .2 s, and once more at the end .3 s.
    gc.set_threshold(50_000)
    status = main()
    gc.freeze()
    sys.exit(status)


if __name__ == "__main__":
    run()
