"""One view on the device: its footprints, its tiles, and how it is cut into pieces that fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from liftcore.raster.constants import TILE
from liftcore.raster.gpu.falloffs import FLOORS, KINDS
from liftcore.raster.gpu.projection import project
from liftcore.raster.gpu.tile_lists import bands_of, lists_of, spans_of
from liftcore.raster.gpu.walk import PART, PARTS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

    from liftcore.raster.gpu.scene import DeviceScene
    from liftcore.raster.gpu.tile_lists import Lists
    from liftcore.raster.projection import View
    from liftcore.raster.protocol import Walk
    from liftcore.scene.splats import Kernel

TILES_AT_ONCE = 4096  # programs of a launch, each with scratch of its own
TABLE_FLOATS = 1 << 26  # of a launch's table of sums; a single tile may need more


class Frame:
    """One view, projected. All cuts follow from the scene and the view, never from what memory happens to be free."""

    def __init__(self, scene: DeviceScene, view: View, kernel: Kernel, walk: Walk) -> None:
        footprints = project(scene, view, kernel, walk.antialiased)
        self.width, self.height = view.width, view.height
        self.columns, self.rows = -(-view.width // TILE), -(-view.height // TILE)
        self.ids = footprints.ids  # [n] i32, the splat of a footprint
        self.splats = footprints.places, footprints.inks  # as the kernels take them
        self.size = self.columns, self.width, self.height
        self.cuts = walk.alpha_cap, walk.transmittance_stop, FLOORS[kernel]
        self.kind = KINDS[kernel]
        self._spans = spans_of(footprints.outlines, self.rows, self.columns)
        self._bands = bands_of(self._spans, self.rows)
        self._lists: Lists | None = None

    @property
    def device(self) -> torch.device:
        """Where it lies."""
        return self.ids.device

    def lists(self) -> Iterator[Lists]:
        """The tile lists, band by band; those of a view of one band are kept."""
        if len(self._bands) > 1:
            for band in self._bands:
                yield lists_of(self._spans, band, self.columns)
            return
        if self._lists is None:
            self._lists = lists_of(self._spans, self._bands[0], self.columns)
        yield self._lists

    def scratch(self, tiles: int, parts: int = PARTS) -> Tensor:
        """Room for the chunks of ``tiles`` programs."""
        return torch.empty(tiles * parts * PART, dtype=torch.float32, device=self.device)


def tile_runs(lists: Lists) -> list[tuple[int, int]]:
    """Runs ``(first, last + 1)`` of a band's tiles, for one launch each."""
    return [(first, min(first + TILES_AT_ONCE, lists.tiles)) for first in range(0, lists.tiles, TILES_AT_ONCE)]


def table_runs(first: int, sizes: list[int]) -> list[tuple[int, int]]:
    """Runs of the tiles from ``first`` on whose tables of ``sizes`` floats stay within ``TABLE_FLOATS`` together."""
    runs, begun, held = [], 0, 0
    for tile, size in enumerate(sizes):
        if tile > begun and held + size > TABLE_FLOATS:
            runs.append((first + begun, first + tile))
            begun, held = tile, 0
        held += size
    return [*runs, (first + begun, first + len(sizes))]
