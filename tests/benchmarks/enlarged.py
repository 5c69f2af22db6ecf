"""Feature grids enlarged to more cells, bilinearly: dense maps of one's own scene, to measure what fine cells cost.

python -m tests.benchmarks.enlarged PACK --rows H --columns W -o FILE
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from torch.nn.functional import interpolate

from liftcore.errors import InvalidFeatures
from liftcore.features.pack import open_packs
from liftcore.features.views import FeatureGrid, ViewFeatures
from liftcore.features.write_pack import write_pack

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.features.pack import FeaturePacks


class Enlarged(Mapping[str, ViewFeatures]):
    """The views of packs with so many (rows, columns) of cells, each made when it is asked for."""

    def __init__(self, packs: FeaturePacks, cells: tuple[int, int]) -> None:
        self._packs, self._cells = packs, cells

    def __getitem__(self, view: str) -> FeatureGrid:
        """The view's grid, enlarged.

        Raises:
            InvalidFeatures: the view has regions, and no cells.
        """
        observation = self._packs.observation(view)
        if not isinstance(observation, FeatureGrid):
            raise InvalidFeatures("features", expected="grids in all views", got=f"regions in {view}")
        return FeatureGrid(enlarged(observation.grid, self._cells))

    def __iter__(self) -> Iterator[str]:
        return iter(self._packs.views)

    def __len__(self) -> int:
        return len(self._packs.views)


def enlarged(grid: Tensor, cells: tuple[int, int]) -> Tensor:
    """[h, w, F] -> [rows, columns, F] of the same type, read at half-pixel centres as `FeatureGrid` is."""
    channels_first = grid.float().permute(2, 0, 1)[None]
    larger = interpolate(channels_first, size=cells, mode="bilinear", align_corners=False)
    return larger[0].permute(1, 2, 0).to(grid.dtype).contiguous()


def main() -> None:
    """Write the pack."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.enlarged", description=__doc__)
    parser.add_argument("pack", type=Path, metavar="PACK", help="of feature grids")
    parser.add_argument("--rows", type=int, required=True, metavar="H", help="of cells")
    parser.add_argument("--columns", type=int, required=True, metavar="W", help="of cells")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE")
    options = parser.parse_args()
    packs = open_packs([options.pack])
    metadata = {"encoder": packs.encoder, "text_space": packs.text_space, "normalised": "false"}
    write_pack(options.output, Enlarged(packs, (options.rows, options.columns)), metadata)


if __name__ == "__main__":
    main()
