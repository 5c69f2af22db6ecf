"""Tile lists on the device, for all projected splats at once.

Every projected splat is split into spans, one per tile row, by the same bounds as on the CPU. Counts and prefix sums
give the offset of each span's tiles, in depth order; a stable sort by tile keeps that order inside a tile.
"""

from typing import NamedTuple

import torch
import triton.language as tl
from torch import Tensor

from liftcore.raster.cpu import project as projected
from liftcore.raster.cpu.project import View
from liftcore.raster.gpu.composite import FLOORS, KINDS
from liftcore.raster.gpu.launching import jit, lang, launch
from liftcore.raster.gpu.project import kernel_inputs
from liftcore.scene.compositing import TILE, CompositingParams
from liftcore.scene.splats import Kernel

SPANS = 256  # per program
_TILE = tl.constexpr(TILE)
_OUTLINE = (
    projected.MX, projected.MY, projected.SLOPE, projected.SQRT_A, projected.C, projected.CUTOFF,
    projected.EXTENT_X, projected.EXTENT_Y, projected.RIGHTMOST_DY,
)  # fmt: skip
_CIRCLE = projected.CENTRE_X, projected.CENTRE_Y, projected.NEARBY  # covered beside the outline, of 2DGS


class Frame(NamedTuple):
    """One view on the device: its projected splats, near to far, and the lists of its tiles."""

    ids: Tensor  # [n] i32, the splat of a projected splat
    splats: tuple[Tensor, Tensor]  # places [n, PLACE] f64 and inks [n, INK] f32
    starts: Tensor  # [tiles + 1] i64, each tile's list in items
    items: Tensor  # [m] i32, rows of projected splats, near to far in each tile
    size: tuple[int, int, int]  # tiles a row, width and height in pixels
    cuts: tuple[float, float, float]  # alpha cap, transmittance stop, alpha floor
    kind: int  # of splats, as kernels number them


def frame_of(ids: Tensor, splats: Tensor, view: View, kernel: Kernel, params: CompositingParams) -> Frame:
    """Return a view of projected splats.

    Args:
        ids: [n] i32, the splats, near to far. splats: [n, COLUMNS] f64, their projections.
    """
    columns, rows = -(-view.width // TILE), -(-view.height // TILE)
    cuts = params.alpha_cap, params.transmittance_stop, FLOORS[kernel]
    inputs, lists = kernel_inputs(splats, kernel, view), _tile_lists(splats, kernel, rows, columns)
    return Frame(ids, inputs, *lists, (columns, view.width, view.height), cuts, KINDS[kernel])


def _tile_lists(splats: Tensor, kernel: Kernel, rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """Return starts [tiles + 1] i64 and items [m] i32 of the lists of all tiles."""
    # Copies, of any number of splats: kernels are compiled for aligned tensors.
    outline = [splats[:, column].clone() for column in _OUTLINE]
    has_circles = kernel is Kernel.GAUSSIAN_2D
    circle = [splats[:, column].clone() if has_circles else splats.new_empty(0) for column in _CIRCLE]
    middle, reach = splats[:, projected.MY], splats[:, projected.EXTENT_Y]
    top, bottom = _tiles_between(middle - reach, middle + reach)
    if has_circles:
        near_top, near_bottom = _tiles_between(circle[1] - circle[2], circle[1] + circle[2])
        top, bottom = torch.minimum(top, near_top), torch.maximum(bottom, near_bottom)
    top = top.clamp(min=0.0)
    splat, step = expand_counts((bottom.clamp(max=rows - 1.0) - top + 1.0).clamp(min=0.0).long())
    count = splat.shape[0]
    span_rows, firsts, counts = (torch.empty(count, dtype=torch.int32, device=splat.device) for _ in range(3))
    launch(
        _cut, -(-count // SPANS), *outline, *circle, top, splat, step, span_rows, firsts, counts, columns, count,
        CIRCLES=has_circles, SPANS=SPANS,
    )  # fmt: skip
    span, step = expand_counts(counts.long())
    by_tile = torch.sort(((span_rows * columns + firsts)[span] + step).to(torch.int32), stable=True)
    edges = torch.arange(rows * columns + 1, dtype=torch.int32, device=splat.device)
    return torch.searchsorted(by_tile.values, edges), splat[span[by_tile.indices]].to(torch.int32)


def expand_counts(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return for counts [n] i64 the row [sum] i64 of each counted element, and its number [sum] i64 in that row."""
    ends = torch.cumsum(counts, 0)
    total = int(ends[-1]) if ends.numel() else 0
    rows = torch.repeat_interleave(counts, output_size=total)
    return rows, torch.arange(total, device=counts.device) - (ends - counts)[rows]


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
