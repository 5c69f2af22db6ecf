"""One view on the device: its footprints, its tiles, and how it is cut into pieces that fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from liftcore.raster.base import TILE
from liftcore.raster.gpu.falloffs import FLOORS, KINDS
from liftcore.raster.gpu.projection import project, project_again
from liftcore.raster.gpu.room import footprint_bytes
from liftcore.raster.gpu.survey import strips_of, survey
from liftcore.raster.gpu.tile_lists import bands_of, items_by_row, lists_of, spans_of
from liftcore.raster.gpu.walk import PART, PARTS

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.base import CompositingParams
    from liftcore.raster.gpu.projection import Projection
    from liftcore.raster.gpu.room import Room
    from liftcore.raster.gpu.tile_lists import Lists

UNIT = 16  # tiles in a row whose sums are made together; launches begin and end with them


class Frame:
    """One view, cut as the room asks. Where a cut falls changes no bit of what is made from it.

    With room for all footprints they are made once and kept, and lists come band by band. Without, the scene is
    surveyed in blocks, and each strip of tile rows projects its own splats again.

    Args:
        projection: of the scene. walk: how its rays go. room: for the pieces.
    """

    def __init__(self, projection: Projection, walk: CompositingParams, room: Room) -> None:
        view, kernel = projection.view, projection.kernel
        self.device, self.room = projection.device, room
        self.width, self.height = view.width, view.height
        self.columns, self.rows = -(-view.width // TILE), -(-view.height // TILE)
        self.size = self.columns, self.width, self.height
        self.cuts = walk.alpha_cap, walk.transmittance_stop, FLOORS[kernel]
        self.kind = KINDS[kernel]
        self._projection = projection
        self._lists: Lists | None = None
        if self.room.footprints is None:
            self._whole = project(self._projection)
            self._spans = spans_of(self._whole.outlines, (0, self.rows), self.columns, self.room.spanned)
            self.bands = bands_of(items_by_row(self._spans, self.rows).tolist(), self.room.items)
        else:
            self._whole = None
            self._survey = survey(self._projection, (self.rows, self.columns), self.room)
            self.bands = strips_of(self._survey, footprint_bytes(kernel), self.room)

    def lists_of(self, band: tuple[int, int]) -> Lists:
        """The tile lists of a band; those of a view of one band are kept.

        They are a strip's footprints too, so whoever asks holds them in a function that ends before the next band's.
        """
        if len(self.bands) > 1:
            return self._made(band)
        if self._lists is None:
            self._lists = self._made(band)
        return self._lists

    def _made(self, band: tuple[int, int]) -> Lists:
        if self._whole is not None:
            return lists_of(self._whole, self._spans, band, self.columns)
        footprints = project_again(self._projection, self._survey.within(band))
        spans = spans_of(footprints.outlines, band, self.columns, self.room.spanned)
        return lists_of(footprints, spans, band, self.columns)

    def scratch(self, tiles: int, parts: int = PARTS) -> Tensor:
        """Room for the chunks of ``tiles`` programs."""
        return torch.empty(tiles * parts * PART, dtype=torch.float32, device=self.device)

    def tile_runs(self, lists: Lists) -> list[tuple[int, int]]:
        """Runs ``(first, last + 1)`` of a band's tiles, whole units, for one launch each."""
        runs, first = [], 0
        ends = self.unit_ends(0, lists.tiles)
        for unit, end in zip([0, *ends], ends, strict=False):
            if unit > first and end - first > self.room.tiles:
                runs.append((first, unit))
                first = unit
        return [*runs, (first, lists.tiles)]

    def table_runs(self, tiles: tuple[int, int], sizes: Tensor) -> list[tuple[int, int, int]]:
        """Runs of whole units whose tables stay within the room together, and the floats of each.

        Args:
            tiles: first and last + 1, whole units. sizes: [tiles] i64, floats of a tile's table.
        """
        ends = self.unit_ends(*tiles)
        firsts = [tiles[0], *ends[:-1]]
        totals = torch.cumsum(sizes, 0)[torch.tensor(ends, device=sizes.device) - tiles[0] - 1].tolist()
        runs, begun, before, last = [], tiles[0], 0, 0
        for unit, total in zip(firsts, totals, strict=True):
            if unit > begun and total - before > self.room.table:
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
        """Rows [P, ...] of splats, on the host, as rows of a band's footprints, on the device."""
        if self.room.footprints is None:
            return values.to(self.device)[lists.ids.long()]
        return values[lists.ids.long().cpu()].to(self.device)
