"""One front-to-back order for a whole view: a stable radix sort of float32 depths.

Ties keep the order of the splats' rows, so the order, and with it every product, is unique.
"""

from __future__ import annotations

import numpy as np

from liftcore.jit import kernel

_DIGIT = 11  # bits a pass; three passes cover a float32
_BUCKETS = 1 << _DIGIT


@kernel
def depth_order(keys, places):
    """Sort ``places`` by their keys.

    Args:
        keys: [n] u32, the bits of positive float32 depths (they order like the depths).
        places: [n] i32, what to sort.

    Returns:
        [n] i32, the places from near to far.
    """
    n = keys.shape[0]
    other_keys = np.empty_like(keys)
    other_places = np.empty_like(places)
    counts = np.empty(_BUCKETS, np.int64)
    for turn in range(3):
        shift = np.uint32(turn * _DIGIT)
        counts[:] = 0
        for i in range(n):
            counts[(keys[i] >> shift) & np.uint32(_BUCKETS - 1)] += 1
        total = 0
        for b in range(_BUCKETS):
            count = counts[b]
            counts[b] = total
            total += count
        for i in range(n):
            bucket = (keys[i] >> shift) & np.uint32(_BUCKETS - 1)
            slot = counts[bucket]
            counts[bucket] = slot + 1
            other_keys[slot] = keys[i]
            other_places[slot] = places[i]
        keys, other_keys = other_keys, keys
        places, other_places = other_places, places
    return places
