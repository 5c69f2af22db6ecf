"""What one view observes: ``B = S E`` with a codebook E [M, F] and a sparse reading S [rays, M].

S is never built. A region map says for every pixel which codebook row each level reads; a feature grid is
read by bilinear interpolation, four rows a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

NO_LABEL = -1  # a pixel that a level leaves unlabelled


@dataclass(frozen=True)
class Regions:
    """Regions with one embedding each; every labelled level of a ray is a row of its own.

    The map may have another size than the image: pixel (x, y) of a W x H image reads
    ``labels[:, floor((y + 0.5) h / H), floor((x + 0.5) w / W)]``.
    """

    labels: Tensor  # [L, h, w] i32, rows of the codebook, -1 = none
    codebook: Tensor  # [M, F] f16 or f32


@dataclass(frozen=True)
class FeatureGrid:
    """A dense feature map, read bilinearly with half-pixel centres and clamped borders.

    Pixel (x, y) of a W x H image samples the grid at ``u = (x + 0.5) w / W - 0.5`` and
    ``v = (y + 0.5) h / H - 0.5``, clamped to the grid (``align_corners=False``).
    Cell (r, c) is codebook row ``r * w + c``.
    """

    grid: Tensor  # [h, w, F] f16 or f32

    @property
    def codebook(self) -> Tensor:
        """[h * w, F], a view of the grid."""
        return self.grid.reshape(-1, self.grid.shape[-1])


ViewFeatures = Regions | FeatureGrid
