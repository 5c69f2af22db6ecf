"""Names of ``simd`` under their old path, until nobody asks for them here."""

from liftcore.raster.cpu.simd import (
    LANES,
    compiled,
    copy_values,
    fetch_place,
    in_all_lanes,
    keep_halves,
    keep_lanes,
    lanes_at,
    no_lanes,
    plus,
    plus_product,
    sum_of_lanes,
)

__all__ = [
    "LANES", "compiled", "copy_values", "fetch_place", "in_all_lanes", "keep_halves", "keep_lanes", "lanes_at",
    "no_lanes", "plus", "plus_product", "sum_of_lanes",
]  # fmt: skip
