"""Anonymous memory maps on each system. Imports no torch, as processes without it map memory too."""

import mmap
import sys


def map_anonymous(size: int, flags: int = 0) -> mmap.mmap:
    """Map ``size`` bytes of zeros, private to this process; pages are allocated when they are first written.

    Args:
        flags: further flags of mmap, ignored on Windows, whose maps are backed by the page file.
    """
    if sys.platform == "win32":
        return mmap.mmap(-1, size)
    return mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | flags)
