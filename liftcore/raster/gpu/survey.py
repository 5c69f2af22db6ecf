"""A view whose footprints do not all fit: what is known of each before any is kept.

The scene passes in blocks, and of a footprint that touches the image nothing is kept but its splat, its depth and its
tile rows. That says how the view is cut into strips of tile rows, and which splats each strip projects again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch

from liftcore.raster.gpu.projection import blocks, footprints_of
from liftcore.raster.gpu.room import A_SEEN
from liftcore.raster.gpu.tile_lists import items_by_row, spans_of, tile_rows_of

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.gpu.projection import Projection
    from liftcore.raster.gpu.room import Room


class Survey(NamedTuple):
    """The splats that touch the image, near to far, ties in the order of the file; on the host if they are many."""

    ids: Tensor  # [n] i32
    firsts: Tensor  # [n] i32, the first tile row
    lasts: Tensor  # [n] i32, the last one
    items: list[int]  # of each tile row, the length of its lists

    def within(self, strip: tuple[int, int]) -> Tensor:
        """The splats that may touch the tile rows ``strip[0]..strip[1]``."""
        return self.ids[(self.firsts < strip[1]) & (self.lasts >= strip[0])]


def survey(projection: Projection, tiles: tuple[int, int], room: Room) -> Survey:
    """Look at all splats, a block at a time.

    Args:
        tiles: rows and columns of the view.
    """
    rows, columns = tiles
    items = torch.zeros(rows, dtype=torch.int64, device=projection.device)
    known: list[list[Tensor]] = []
    held, place = 0, projection.device
    for block in blocks(projection.scene.means.shape[0], projection.at_once):
        part, depths = footprints_of(projection, block)
        items += items_by_row(spans_of(part.outlines, (0, rows), columns, room.spanned), rows)
        first, last = tile_rows_of(part.outlines, (0, rows))
        known.append([column.to(place) for column in (part.ids, depths, first.to(torch.int32), last.to(torch.int32))])
        held += A_SEEN * depths.shape[0]
        if room.survey is not None and held > room.survey and place.type != "cpu":
            place = torch.device("cpu")
            known = [[column.cpu() for column in columns_] for columns_ in known]
    ids, depths, firsts, lasts = (torch.cat(column) for column in zip(*known, strict=True))
    order = torch.sort(depths, stable=True).indices
    return Survey(ids[order], firsts[order], lasts[order], items.tolist())


def strips_of(seen: Survey, footprint_bytes: int, room: Room) -> list[tuple[int, int]]:
    """First and last + 1 tile row of every strip: as many rows as their footprints and lists leave room for."""
    rows = len(seen.items)
    begun, ended = (torch.bincount(column, minlength=rows).cumsum(0).tolist() for column in (seen.firsts, seen.lasts))
    most = len(seen.ids) if room.footprints is None else room.footprints // footprint_bytes
    strips, first, held = [], 0, 0
    for row, items in enumerate(seen.items):
        # Those that begin by this row, less those that end before the strip.
        footprints = begun[row] - (ended[first - 1] if first else 0)
        if row > first and (footprints > most or held + items > room.items):
            strips.append((first, row))
            first, held = row, 0
        held += items
    return [*strips, (first, rows)]
