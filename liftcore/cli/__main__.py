"""``python -m liftcore.cli``: as ``splatlift``."""

import sys

from liftcore.cli import main

sys.exit(main())
