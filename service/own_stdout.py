"""The standard output of a process that reports over it."""

from __future__ import annotations

import os
from typing import BinaryIO


def own_stdout() -> BinaryIO:
    """The pipe to whoever started this process, for reports only: what libraries print goes to stderr from now on."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return out
