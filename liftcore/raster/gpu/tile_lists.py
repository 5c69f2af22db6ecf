"""Which splats touch which tile, on the device: ``liftcore.raster.cpu.tiles`` for all footprints at once.

Every footprint is cut into spans, one a tile row, by the same bounds as on the CPU. Counts and prefix sums say where
each span's tiles go, in the order of depth; a stable sort by tile then keeps that order inside a tile. A view whose
lists would outgrow their room is walked in bands of tile rows, with the lists of one band at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch

from liftcore.raster.base import TILE

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.gpu.scene import Footprints, Outlines


class Spans(NamedTuple):
    """Runs of tiles in a tile row that a footprint touches: by splat, near to far, then by row."""

    places: Tensor  # [s] i32, the footprint
    rows: Tensor  # [s] i32, the tile row
    firsts: Tensor  # [s] i32, the first tile column
    counts: Tensor  # [s] i32, at least one


class Lists(NamedTuple):
    """The lists of the tiles of a band of tile rows, and the footprints that they name."""

    first_row: int  # of the band, in the view
    columns: int  # tiles of a row
    starts: Tensor  # [tiles + 1] i64, each tile's list in items
    items: Tensor  # [n] i32, footprints, near to far in each tile
    ids: Tensor  # [f] i32, the splat of a footprint
    splats: tuple[Tensor, Tensor]  # places [f, PLACE] f64 and inks [f, INK] f32, as the kernels take them

    @property
    def tiles(self) -> int:
        """Of the band."""
        return self.starts.shape[0] - 1

    @property
    def first_tile(self) -> int:
        """Of the band, in the view."""
        return self.first_row * self.columns


def spans_of(outlines: Outlines, rows: tuple[int, int], columns: int, at_once: int) -> Spans:
    """The spans of all footprints in the tile rows ``rows[0]..rows[1]`` of a view with ``columns`` tiles a row.

    Args:
        at_once: footprints whose spans are made at a time, in float64.
    """
    parts = []
    for first in range(0, outlines.mx.shape[0], at_once):
        own = outlines.at(slice(first, first + at_once))
        parts.append(_spans(own, rows, columns, first))
    if not parts:
        none = torch.empty(0, dtype=torch.int32, device=outlines.mx.device)
        return Spans(none, none, none, none)
    return Spans(*(torch.cat(columns_) for columns_ in zip(*parts, strict=True)))


def items_by_row(spans: Spans, rows: int) -> Tensor:
    """[rows] i64, the length of the lists of every tile row. Whole numbers are added, whose sum knows no order."""
    totals = torch.zeros(rows, dtype=torch.int64, device=spans.rows.device)
    return totals.index_add_(0, spans.rows, spans.counts.long())


def bands_of(items: list[int], most: int) -> list[tuple[int, int]]:
    """First and last + 1 tile row of every band: as many rows as ``most`` leaves room for, at least one.

    Args:
        items: of each tile row.
    """
    bands, first, held = [], 0, 0
    for row, total in enumerate(items):
        if row > first and held + total > most:
            bands.append((first, row))
            first, held = row, 0
        held += total
    return [*bands, (first, len(items))]


def lists_of(footprints: Footprints, spans: Spans, band: tuple[int, int], columns: int) -> Lists:
    """The lists of the tiles of the rows ``band[0]..band[1]``."""
    tiles = (band[1] - band[0]) * columns
    own = ((spans.rows >= band[0]) & (spans.rows < band[1])).nonzero()[:, 0]
    counts = spans.counts[own].long()
    span, step = expanded(counts)
    first = (spans.rows[own] - band[0]) * columns + spans.firsts[own]
    by_tile = torch.sort((first[span] + step).to(torch.int32), stable=True)
    items = spans.places[own][span[by_tile.indices]]
    edges = torch.arange(tiles + 1, dtype=torch.int32, device=items.device)
    starts = torch.searchsorted(by_tile.values, edges)
    return Lists(band[0], columns, starts, items, footprints.ids, (footprints.places, footprints.inks))


def tile_rows_of(own: Outlines, rows: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """First and last of the rows ``rows[0]..rows[1]`` that footprints can touch, [n] f64; first > last for none."""
    top, bottom = _tiles_between(own.my - own.extent_y, own.my + own.extent_y)
    if own.circle.numel():
        near_top, near_bottom = _tiles_between(own.circle_y - own.circle, own.circle_y + own.circle)
        top, bottom = torch.minimum(top, near_top), torch.maximum(bottom, near_bottom)
    return top.clamp(min=rows[0]), bottom.clamp(max=rows[1] - 1.0)


def expanded(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For counts [n] i64: the row [sum] i64 that each of the counted is of, and its number [sum] i64 in that row."""
    ends = torch.cumsum(counts, 0)
    total = int(ends[-1]) if ends.numel() else 0
    rows = torch.repeat_interleave(counts, output_size=total)
    return rows, torch.arange(total, device=counts.device) - (ends - counts)[rows]


def _spans(own: Outlines, rows: tuple[int, int], columns: int, base: int) -> Spans:
    top, bottom = tile_rows_of(own, rows)
    place, step = expanded((bottom - top + 1.0).clamp(min=0.0).long())
    tile_row = top[place] + step
    first, last = _tile_columns(own.at(place), tile_row)
    first, last = first.clamp(min=0.0), last.clamp(max=columns - 1.0)
    kept = (first <= last).nonzero()[:, 0]
    whole = (place[kept] + base, tile_row[kept], first[kept], last[kept] - first[kept] + 1.0)
    return Spans(*(column.to(torch.int32) for column in whole))


def _tiles_between(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """First and last tile of a row or column whose pixel centres lie between two places; none when none does."""
    return torch.floor(torch.ceil(low - 0.5) / TILE), torch.floor(torch.floor(high - 0.5) / TILE)


def _tile_columns(own: Outlines, tile_row: Tensor) -> tuple[Tensor, Tensor]:
    """First and last tile column that a footprint touches in a tile row, clamped nowhere."""
    first, last = _outline_columns(own, tile_row)
    if not own.circle.numel():
        return first, last
    meets = (tile_row * TILE + 0.5 * TILE - own.circle_y).abs() <= own.circle + 0.5 * TILE
    near_first, near_last = _tiles_between(own.circle_x - own.circle, own.circle_x + own.circle)
    alone = first > last
    low = torch.where(alone, near_first, torch.minimum(first, near_first))
    high = torch.where(alone, near_last, torch.maximum(last, near_last))
    return torch.where(meets, low, first), torch.where(meets, high, last)


def _outline_columns(own: Outlines, tile_row: Tensor) -> tuple[Tensor, Tensor]:
    """First and last tile column that the outline touches between a tile row's first and last pixel centres."""
    narrow, wide = _tiles_between(own.mx - own.extent_x, own.mx + own.extent_x)
    low = torch.maximum(tile_row * TILE + 0.5 - own.my, -own.extent_y)
    high = torch.minimum(tile_row * TILE + TILE - 0.5 - own.my, own.extent_y)
    lean = own.lean
    within = (low <= lean) & (lean <= high)
    right = torch.where(within, own.extent_x, _edge(own, torch.where(lean > low, high, low), 1.0))
    within = (low <= -lean) & (-lean <= high)
    left = torch.where(within, -own.extent_x, _edge(own, torch.where(-lean > low, high, low), -1.0))
    first, last = _tiles_between(own.mx + left, own.mx + right)
    outside = low > high
    first, last = torch.where(outside, 0.0, first), torch.where(outside, -1.0, last)
    single = narrow == wide  # one column at most: no need to look closer
    return torch.where(single, narrow, first), torch.where(single, wide, last)


def _edge(own: Outlines, dy: Tensor, side: float) -> Tensor:
    """x of the outline's left (-1) or right (+1) edge at dy, relative to its centre."""
    room = (own.cutoff - own.ky * dy * dy).clamp(min=0.0)
    return own.slope * dy + side * torch.sqrt(room) / own.root_x
