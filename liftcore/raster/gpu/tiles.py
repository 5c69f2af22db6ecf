"""Tile lists on the device, for all projected splats at once; and the division of a view into blocks.

Every projected splat is split into spans, one per tile row, by the same bounds as on the CPU. Counts and prefix sums
give the offset of each span's tiles, in depth order; a stable sort by tile keeps that order inside a tile. A view
whose lists exceed a block is processed in bands of tile rows, with the lists of one band at a time.
"""

from typing import NamedTuple

import torch
import triton.language as tl
from torch import Tensor

from liftcore.raster.cpu.project import View
from liftcore.raster.gpu.composite import FLOORS, KINDS, PART, PARTS
from liftcore.raster.gpu.launching import jit, lang, launch
from liftcore.raster.gpu.project import DeviceScene, Outlines, ProjectedSplats, project
from liftcore.scene.compositing import TILE, CompositingParams
from liftcore.scene.splats import Kernel

SPANS = 256  # per program
_TILE = tl.constexpr(TILE)


class TileSpans(NamedTuple):
    """Runs of tiles in a tile row that a projected splat touches: ordered by splat, near to far, then by row."""

    places: Tensor  # [s] i32, rows of projected splats
    rows: Tensor  # [s] i32, the tile row
    firsts: Tensor  # [s] i32, the first tile column
    counts: Tensor  # [s] i32, at least one


class TileLists(NamedTuple):
    """The lists of the tiles of a band of tile rows, and the projected splats to which they refer."""

    first_row: int  # of the band, in the view
    columns: int  # tiles per row
    starts: Tensor  # [tiles + 1] i64, each tile's list in items
    items: Tensor  # [n] i32, rows of projected splats, near to far in each tile
    ids: Tensor  # [f] i32, the splat of a projected splat
    splats: tuple[Tensor, Tensor]  # places [f, PLACE] f64 and inks [f, INK] f32

    @property
    def tiles(self) -> int:
        """The number of tiles of the band."""
        return self.starts.shape[0] - 1

    @property
    def first_tile(self) -> int:
        """The first tile of the band, in the view."""
        return self.first_row * self.columns


def spans_of(outlines: Outlines, rows: tuple[int, int], columns: int, at_once: int) -> TileSpans:
    """Return the spans of all projected splats in the tile rows ``rows[0]..rows[1]`` of ``columns`` tiles.

    Args:
        at_once: projected splats per block, whose intermediate tensors are float64.
    """
    parts = []
    for first in range(0, outlines.mx.shape[0], at_once):
        block = outlines.at(slice(first, first + at_once))
        parts.append(_spans(block, rows, columns, first))
    if not parts:
        none = torch.empty(0, dtype=torch.int32, device=outlines.mx.device)
        return TileSpans(none, none, none, none)
    return TileSpans(*(torch.cat(columns_) for columns_ in zip(*parts, strict=True)))


def items_by_row(spans: TileSpans, rows: int) -> Tensor:
    """Return the number of list items of every tile row, [rows] i64. Integer sums do not depend on their order."""
    totals = torch.zeros(rows, dtype=torch.int64, device=spans.rows.device)
    return totals.index_add_(0, spans.rows, spans.counts.long())


def bands_of(items: list[int], limit: int) -> list[tuple[int, int]]:
    """Return first and last + 1 tile row of every band: rows of at most ``limit`` items together, at least one row.

    Args:
        items: of each tile row.
    """
    bands, first, band_items = [], 0, 0
    for row, total in enumerate(items):
        if row > first and band_items + total > limit:
            bands.append((first, row))
            first, band_items = row, 0
        band_items += total
    return [*bands, (first, len(items))]


def lists_of(projected: ProjectedSplats, spans: TileSpans, band: tuple[int, int], columns: int) -> TileLists:
    """Return the lists of the tiles of the rows ``band[0]..band[1]``."""
    tiles = (band[1] - band[0]) * columns
    in_band = ((spans.rows >= band[0]) & (spans.rows < band[1])).nonzero()[:, 0]
    counts = spans.counts[in_band].long()
    span, step = expand_counts(counts)
    first = (spans.rows[in_band] - band[0]) * columns + spans.firsts[in_band]
    by_tile = torch.sort((first[span] + step).to(torch.int32), stable=True)
    items = spans.places[in_band][span[by_tile.indices]]
    edges = torch.arange(tiles + 1, dtype=torch.int32, device=items.device)
    starts = torch.searchsorted(by_tile.values, edges)
    return TileLists(band[0], columns, starts, items, projected.ids, (projected.places, projected.inks))


def tile_rows_of(outlines: Outlines, rows: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return first and last of the rows ``rows[0]..rows[1]`` that splats can touch, [n] f64; first > last if none."""
    top, bottom = _tiles_between(outlines.my - outlines.extent_y, outlines.my + outlines.extent_y)
    if outlines.circle.numel():
        near_top, near_bottom = _tiles_between(
            outlines.circle_y - outlines.circle, outlines.circle_y + outlines.circle
        )
        top, bottom = torch.minimum(top, near_top), torch.maximum(bottom, near_bottom)
    return top.clamp(min=rows[0]), bottom.clamp(max=rows[1] - 1.0)


def expand_counts(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return for counts [n] i64 the row [sum] i64 of each counted element, and its number [sum] i64 in that row."""
    ends = torch.cumsum(counts, 0)
    total = int(ends[-1]) if ends.numel() else 0
    rows = torch.repeat_interleave(counts, output_size=total)
    return rows, torch.arange(total, device=counts.device) - (ends - counts)[rows]


def _spans(outlines: Outlines, rows: tuple[int, int], columns: int, base: int) -> TileSpans:
    top, bottom = tile_rows_of(outlines, rows)
    splat, step = expand_counts((bottom - top + 1.0).clamp(min=0.0).long())
    count = splat.shape[0]
    outputs = [torch.empty(count, dtype=torch.int32, device=splat.device) for _ in range(3)]
    launch(
        _cut, -(-count // SPANS), *outlines, top, splat, step, *outputs, columns, count,
        CIRCLES=outlines.circle.numel() > 0, SPANS=SPANS,
    )  # fmt: skip
    nonempty = outputs[2].nonzero()[:, 0]
    return TileSpans((splat[nonempty] + base).to(torch.int32), *(column[nonempty] for column in outputs))


def _tiles_between(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first and last tile of a row or column with pixel centres in low..high; first > last if none."""
    return torch.floor(torch.ceil(low - 0.5) / TILE), torch.floor(torch.floor(high - 0.5) / TILE)


@jit
def _cut(
    mx, my, slope, sqrt_a, c, cutoff, extent_x, extent_y, rightmost_dy, circle_x, circle_y, circle, top, splats,
    steps, rows, firsts, counts, columns, count, CIRCLES: tl.constexpr, SPANS: tl.constexpr,
):  # fmt: skip
    """Compute the tile columns that splats touch in their tile rows, a span per lane; the count is 0 if none."""
    span = tl.program_id(0) * SPANS + tl.arange(0, SPANS)
    mask = span < count
    splat = tl.load(splats + span, mask=mask, other=0)
    row = tl.load(top + splat, mask=mask, other=0.0) + tl.load(steps + span, mask=mask, other=0).to(tl.float64)
    x, y = tl.load(mx + splat, mask=mask, other=0.0), tl.load(my + splat, mask=mask, other=0.0)
    wide, high = tl.load(extent_x + splat, mask=mask, other=0.0), tl.load(extent_y + splat, mask=mask, other=0.0)
    leans = tl.load(rightmost_dy + splat, mask=mask, other=0.0)
    slopes, roots = tl.load(slope + splat, mask=mask, other=0.0), tl.load(sqrt_a + splat, mask=mask, other=1.0)
    curves, reach = tl.load(c + splat, mask=mask, other=0.0), tl.load(cutoff + splat, mask=mask, other=0.0)
    begin = tl.maximum(row * _TILE + 0.5 - y, -high)  # of the outline, between the row's first and last pixel centres
    end = tl.minimum(row * _TILE + _TILE - 0.5 - y, high)
    right = _edge(tl.where(leans > end, end, begin), 1.0, slopes, roots, curves, reach)
    right = tl.where((begin <= leans) & (leans <= end), wide, right)
    left = _edge(tl.where(-leans > end, end, begin), -1.0, slopes, roots, curves, reach)
    left = tl.where((begin <= -leans) & (-leans <= end), -wide, left)
    narrow, broad = _first_tile(x - wide), _last_tile(x + wide)
    single = narrow == broad  # at most one column: no closer bound is needed
    first = tl.where(single, narrow, tl.where(begin > end, 0.0, _first_tile(x + left)))
    last = tl.where(single, broad, tl.where(begin > end, -1.0, _last_tile(x + right)))
    if CIRCLES:
        radius = tl.load(circle + splat, mask=mask, other=0.0)
        near_x = tl.load(circle_x + splat, mask=mask, other=0.0)
        near_y = tl.load(circle_y + splat, mask=mask, other=0.0)
        meets = tl.abs(row * _TILE + 0.5 * _TILE - near_y) <= radius + 0.5 * _TILE
        near_first, near_last = _first_tile(near_x - radius), _last_tile(near_x + radius)
        circle_only = first > last
        low = tl.where(circle_only, near_first, tl.minimum(first, near_first))
        up = tl.where(circle_only, near_last, tl.maximum(last, near_last))
        first = tl.where(meets, low, first)
        last = tl.where(meets, up, last)
    first = tl.maximum(first, 0.0)
    last = tl.minimum(last, columns - 1.0)
    is_hit = first <= last
    tl.store(rows + span, row.to(tl.int32), mask=mask)
    tl.store(firsts + span, tl.where(is_hit, first, 0.0).to(tl.int32), mask=mask)
    tl.store(counts + span, tl.where(is_hit, last - first + 1.0, 0.0).to(tl.int32), mask=mask)


@jit
def _first_tile(low):
    """Return the tile column of the first pixel centre from ``low`` on."""
    return lang.floor(lang.ceil(low - 0.5) / _TILE)


@jit
def _last_tile(high):
    """Return the tile column of the last pixel centre up to ``high``."""
    return lang.floor(lang.floor(high - 0.5) / _TILE)


@jit
def _edge(dy, side, slope, sqrt_a, c, cutoff):
    """Return x of the outline's left (-1) or right (+1) edge at dy, relative to its centre."""
    return slope * dy + side * tl.sqrt(tl.maximum(cutoff - c * dy * dy, 0.0)) / sqrt_a


BLOCK = 1 << 24  # items of tile lists at a time: some 1.5 GB while they are built
UNIT = 16  # adjacent tiles of a row that are summed together; launches begin and end at units


class Frame:
    """One view on the device: its projected splats, its tiles, and their division into blocks.

    Results are bitwise identical for any division.

    Args:
        block: items of tile lists in memory at a time; the other sizes follow from it. A tile row or a unit of tiles
            may need more.
    """

    def __init__(
        self, scene: DeviceScene, view: View, kernel: Kernel, params: CompositingParams, block: int = BLOCK
    ) -> None:
        self.device = scene.means.device
        self.width, self.height = view.width, view.height
        self.columns, self.rows = -(-view.width // TILE), -(-view.height // TILE)
        self.size = self.columns, self.width, self.height
        self.cuts = params.alpha_cap, params.transmittance_stop, FLOORS[kernel]
        self.kind = KINDS[kernel]
        self.tiles_at_once = max(UNIT, block >> 12)  # programs per launch, each with its own scratch
        self.floats_at_once = 4 * block  # of a launch's table of sums
        self.sums_at_once = max(1, block >> 2)  # nonzero sums of a table that are expanded to rows of splats
        self._lists: TileLists | None = None
        self._projected = project(scene, view, kernel, params.antialiased, max(1, block >> 4))
        self._spans = spans_of(self._projected.outlines, (0, self.rows), self.columns, max(1, block >> 5))
        self.bands = bands_of(items_by_row(self._spans, self.rows).tolist(), block)

    def lists_of(self, band: tuple[int, int]) -> TileLists:
        """Return the tile lists of a band; those of a view with a single band are cached.

        Callers hold them in a function that returns before the next band, so that one band's lists are in memory.
        """
        if len(self.bands) > 1:
            return lists_of(self._projected, self._spans, band, self.columns)
        if self._lists is None:
            self._lists = lists_of(self._projected, self._spans, band, self.columns)
        return self._lists

    def scratch(self, tiles: int, parts: int = PARTS) -> Tensor:
        """Allocate the scratch of ``tiles`` programs."""
        return torch.empty(tiles * parts * PART, dtype=torch.float32, device=self.device)

    def tile_runs(self, lists: TileLists) -> list[tuple[int, int]]:
        """Return runs ``(first, last + 1)`` of a band's tiles, whole units, for one launch each."""
        runs, first = [], 0
        ends = self.unit_ends(0, lists.tiles)
        for unit, end in zip([0, *ends], ends, strict=False):
            if unit > first and end - first > self.tiles_at_once:
                runs.append((first, unit))
                first = unit
        return [*runs, (first, lists.tiles)]

    def table_runs(self, tiles: tuple[int, int], sizes: Tensor) -> list[tuple[int, int, int]]:
        """Return runs ``(first, last + 1, floats)`` of whole units whose tables fit together in a block.

        Args:
            tiles: first and last + 1, whole units. sizes: [tiles] i64, floats of a tile's table.
        """
        ends = self.unit_ends(*tiles)
        firsts = [tiles[0], *ends[:-1]]
        totals = torch.cumsum(sizes, 0)[torch.tensor(ends, device=sizes.device) - tiles[0] - 1].tolist()
        runs, run_start, before, last = [], tiles[0], 0, 0
        for unit, total in zip(firsts, totals, strict=True):
            if unit > run_start and total - before > self.floats_at_once:
                runs.append((run_start, unit, last - before))
                run_start, before = unit, last
            last = total
        return [*runs, (run_start, tiles[1], last - before)]

    def unit_of(self, tiles: Tensor) -> Tensor:
        """Return the unit [n] i32 of each tile [n] of the view, ascending if the tiles are."""
        return (tiles // self.columns * -(-self.columns // UNIT) + tiles % self.columns // UNIT).to(torch.int32)

    def unit_ends(self, first: int, last: int) -> list[int]:
        """Return the ends of the units of the tiles ``first..last`` of a band."""
        begins = [
            row + column
            for row in range(first // self.columns * self.columns, last, self.columns)
            for column in range(0, self.columns, UNIT)
        ]
        return [begin for begin in begins if first < begin < last] + [last]
