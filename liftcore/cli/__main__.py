"""``python -m liftcore.cli``: as ``splatlift``."""

import gc
import sys
from typing import NoReturn

from liftcore.cli import main


def run() -> NoReturn:
    """Run a command as the whole of a process, and end it."""
    status = main()
    gc.freeze()  # at its end Python looks through all objects for cycles, and of torch's there are enough for .3 s
    sys.exit(status)


if __name__ == "__main__":
    run()
