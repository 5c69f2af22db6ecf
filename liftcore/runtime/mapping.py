"""Memory by the page, as each system gives it. It knows no torch: processes without it map files too."""

import mmap
import sys


def map_anonymous(size: int, flags: int = 0) -> mmap.mmap:
    """Map ``size`` bytes of zeros that are this process's own, of which no page is taken before it is written.

    Args:
        flags: further flags of mmap, for systems that have them. Windows keeps in its page file what memory has no
            room for.
    """
    if sys.platform == "win32":
        return mmap.mmap(-1, size)
    return mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | flags)
