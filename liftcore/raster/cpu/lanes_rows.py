"""Names of ``simd`` under their old path, until nobody asks for them here."""

from liftcore.raster.cpu.simd import AHEAD, WIDE, add_row_products, add_weighted_row, add_weighted_row_twice

__all__ = ["AHEAD", "WIDE", "add_row_products", "add_weighted_row", "add_weighted_row_twice"]
