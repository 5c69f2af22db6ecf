"""``python -m liftcore.cli``: as ``splatlift``."""

import gc
import sys

from liftcore.cli import main


def run() -> None:
    """Run a command, and exit with its status."""
    # A command runs for seconds, and torch creates many objects. To collect cycles after every 700 new objects takes
    # 0.2 s, and at exit 0.3 s.
    gc.set_threshold(50_000)
    status = main()
    gc.freeze()
    sys.exit(status)


if __name__ == "__main__":
    run()
