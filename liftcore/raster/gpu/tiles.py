"""Which splats touch which tile, on the device, for all projected splats at once; and how a view is cut into blocks.

Every projected splat is cut into spans, one a tile row, by the same bounds as on the CPU. Counts and prefix sums say
where each span's tiles go, in the order of depth; a stable sort by tile then keeps that order inside a tile. A view
whose lists would outgrow a block is walked in bands of tile rows, with the lists of one band at a time.
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

SPANS = 256  # a program
_TILE = tl.constexpr(TILE)


class Spans(NamedTuple):
    """Runs of tiles in a tile row that a projected splat touches: by splat, near to far, then by row."""

    places: Tensor  # [s] i32, the projected splat
    rows: Tensor  # [s] i32, the tile row
    firsts: Tensor  # [s] i32, the first tile column
    counts: Tensor  # [s] i32, at least one


class Lists(NamedTuple):
    """The lists of the tiles of a band of tile rows, and the projected that they name."""

    first_row: int  # of the band, in the view
    columns: int  # tiles of a row
    starts: Tensor  # [tiles + 1] i64, each tile's list in items
    items: Tensor  # [n] i32, projected, near to far in each tile
    ids: Tensor  # [f] i32, the splat of a projected splat
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
    """The spans of all projected in the tile rows ``rows[0]..rows[1]`` of a view with ``columns`` tiles a row.

    Args:
        at_once: projected whose spans are made at a time, in float64.
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


def lists_of(projected: ProjectedSplats, spans: Spans, band: tuple[int, int], columns: int) -> Lists:
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
    return Lists(band[0], columns, starts, items, projected.ids, (projected.places, projected.inks))


def tile_rows_of(own: Outlines, rows: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """First and last of the rows ``rows[0]..rows[1]`` that projected can touch, [n] f64; first > last for none."""
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
    splat, step = expanded((bottom - top + 1.0).clamp(min=0.0).long())
    count = splat.shape[0]
    found = [torch.empty(count, dtype=torch.int32, device=splat.device) for _ in range(3)]
    launch(
        _cut, -(-count // SPANS), *own, top, splat, step, *found, columns, count,
        CIRCLES=own.circle.numel() > 0, SPANS=SPANS,
    )  # fmt: skip
    kept = found[2].nonzero()[:, 0]
    return Spans((splat[kept] + base).to(torch.int32), *(column[kept] for column in found))


def _tiles_between(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """First and last tile of a row or column whose pixel centres lie between two places; none when none does."""
    return torch.floor(torch.ceil(low - 0.5) / TILE), torch.floor(torch.floor(high - 0.5) / TILE)


@jit
def _cut(
    mx, my, slope, root_x, ky, cutoff, extent_x, extent_y, lean, circle_x, circle_y, circle, top, splats, steps,
    rows, firsts, counts, columns, count, CIRCLES: tl.constexpr, SPANS: tl.constexpr,
):  # fmt: skip
    """The tile columns that splats touch in their tile rows, a span a lane; a count of 0 where there are none."""
    span = tl.program_id(0) * SPANS + tl.arange(0, SPANS)
    given = span < count
    splat = tl.load(splats + span, mask=given, other=0)
    row = tl.load(top + splat, mask=given, other=0.0) + tl.load(steps + span, mask=given, other=0).to(tl.float64)
    x, y = tl.load(mx + splat, mask=given, other=0.0), tl.load(my + splat, mask=given, other=0.0)
    wide, high = tl.load(extent_x + splat, mask=given, other=0.0), tl.load(extent_y + splat, mask=given, other=0.0)
    leans = tl.load(lean + splat, mask=given, other=0.0)
    slopes, roots = tl.load(slope + splat, mask=given, other=0.0), tl.load(root_x + splat, mask=given, other=1.0)
    curves, reach = tl.load(ky + splat, mask=given, other=0.0), tl.load(cutoff + splat, mask=given, other=0.0)
    begin = tl.maximum(row * _TILE + 0.5 - y, -high)  # of the outline within the row, by its pixel centres
    end = tl.minimum(row * _TILE + _TILE - 0.5 - y, high)
    right = _edge(tl.where(leans > end, end, begin), 1.0, slopes, roots, curves, reach)
    right = tl.where((begin <= leans) & (leans <= end), wide, right)
    left = _edge(tl.where(-leans > end, end, begin), -1.0, slopes, roots, curves, reach)
    left = tl.where((begin <= -leans) & (-leans <= end), -wide, left)
    narrow, broad = _first_tile(x - wide), _last_tile(x + wide)
    single = narrow == broad  # one column at most: no need to look closer
    first = tl.where(single, narrow, tl.where(begin > end, 0.0, _first_tile(x + left)))
    last = tl.where(single, broad, tl.where(begin > end, -1.0, _last_tile(x + right)))
    if CIRCLES:
        radius = tl.load(circle + splat, mask=given, other=0.0)
        near_x = tl.load(circle_x + splat, mask=given, other=0.0)
        near_y = tl.load(circle_y + splat, mask=given, other=0.0)
        meets = tl.abs(row * _TILE + 0.5 * _TILE - near_y) <= radius + 0.5 * _TILE
        near_first, near_last = _first_tile(near_x - radius), _last_tile(near_x + radius)
        alone = first > last
        low = tl.where(alone, near_first, tl.minimum(first, near_first))
        up = tl.where(alone, near_last, tl.maximum(last, near_last))
        first = tl.where(meets, low, first)
        last = tl.where(meets, up, last)
    first = tl.maximum(first, 0.0)
    last = tl.minimum(last, columns - 1.0)
    touched = first <= last
    tl.store(rows + span, row.to(tl.int32), mask=given)
    tl.store(firsts + span, tl.where(touched, first, 0.0).to(tl.int32), mask=given)
    tl.store(counts + span, tl.where(touched, last - first + 1.0, 0.0).to(tl.int32), mask=given)


@jit
def _first_tile(low):
    """The tile column of the first pixel centre from ``low`` on."""
    return lang.floor(lang.ceil(low - 0.5) / _TILE)


@jit
def _last_tile(high):
    """The tile column of the last pixel centre up to ``high``."""
    return lang.floor(lang.floor(high - 0.5) / _TILE)


@jit
def _edge(dy, side, slope, root_x, ky, cutoff):
    """x of the outline's left (-1) or right (+1) edge at dy, relative to its centre."""
    return slope * dy + side * tl.sqrt(tl.maximum(cutoff - ky * dy * dy, 0.0)) / root_x


BLOCK = 1 << 24  # items of tile lists at a time: some 1.5 GB while they are made
UNIT = 16  # tiles in a row whose sums are made together; launches begin and end with them


class Frame:
    """One view on the device: its projected splats, its tiles, and how the work on them is cut into blocks.

    Where a cut falls changes no bit of what is made from it.

    Args:
        block: items of tile lists that are held at a time; the other sizes follow from it. A tile row or a unit of
            tiles may need more.
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
        self.tiles_at_once = max(UNIT, block >> 12)  # programs of a launch, each with scratch of its own
        self.floats_at_once = 4 * block  # of a launch's table of sums
        self.sums_at_once = max(1, block >> 2)  # that become rows of splats
        self._lists: Lists | None = None
        self._projected = project(scene, view, kernel, params.antialiased, max(1, block >> 4))
        self._spans = spans_of(self._projected.outlines, (0, self.rows), self.columns, max(1, block >> 5))
        self.bands = bands_of(items_by_row(self._spans, self.rows).tolist(), block)

    def lists_of(self, band: tuple[int, int]) -> Lists:
        """The tile lists of a band; those of a view of one band are kept.

        Whoever asks holds them in a function that ends before the next band's.
        """
        if len(self.bands) > 1:
            return lists_of(self._projected, self._spans, band, self.columns)
        if self._lists is None:
            self._lists = lists_of(self._projected, self._spans, band, self.columns)
        return self._lists

    def scratch(self, tiles: int, parts: int = PARTS) -> Tensor:
        """Room for the chunks of ``tiles`` programs."""
        return torch.empty(tiles * parts * PART, dtype=torch.float32, device=self.device)

    def tile_runs(self, lists: Lists) -> list[tuple[int, int]]:
        """Runs ``(first, last + 1)`` of a band's tiles, whole units, for one launch each."""
        runs, first = [], 0
        ends = self.unit_ends(0, lists.tiles)
        for unit, end in zip([0, *ends], ends, strict=False):
            if unit > first and end - first > self.tiles_at_once:
                runs.append((first, unit))
                first = unit
        return [*runs, (first, lists.tiles)]

    def table_runs(self, tiles: tuple[int, int], sizes: Tensor) -> list[tuple[int, int, int]]:
        """Runs of whole units whose tables stay within a block together, and the floats of each.

        Args:
            tiles: first and last + 1, whole units. sizes: [tiles] i64, floats of a tile's table.
        """
        ends = self.unit_ends(*tiles)
        firsts = [tiles[0], *ends[:-1]]
        totals = torch.cumsum(sizes, 0)[torch.tensor(ends, device=sizes.device) - tiles[0] - 1].tolist()
        runs, begun, before, last = [], tiles[0], 0, 0
        for unit, total in zip(firsts, totals, strict=True):
            if unit > begun and total - before > self.floats_at_once:
                runs.append((begun, unit, last - before))
                begun, before = unit, last
            last = total
        return [*runs, (begun, tiles[1], last - before)]

    def unit_of(self, tiles: Tensor) -> Tensor:
        """The unit of tiles of the view [n], i32, ascending as they are."""
        return (tiles // self.columns * -(-self.columns // UNIT) + tiles % self.columns // UNIT).to(torch.int32)

    def unit_ends(self, first: int, last: int) -> list[int]:
        """Where the units of the tiles ``first..last`` of a band end."""
        begins = [
            row + column
            for row in range(first // self.columns * self.columns, last, self.columns)
            for column in range(0, self.columns, UNIT)
        ]
        return [begin for begin in begins if first < begin < last] + [last]

    def of_band(self, image: Tensor, lists: Lists) -> Tensor:
        """The rows of an image [H, W, C] f32 of the host that a band shows, on the device."""
        top = lists.first_row * TILE
        return image[top : top + lists.tiles // self.columns * TILE].to(self.device, torch.float32).contiguous()

    def of_splats(self, values: Tensor, lists: Lists) -> Tensor:
        """Rows [P, ...] of splats as rows of the projected ones, on the device."""
        return values.to(self.device)[lists.ids.long()]
