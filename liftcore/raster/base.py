"""What a raster backend offers: the uses of A, view by view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from liftcore.raster.weighting import MOST_OF_A_RAY, Selection, Weighting

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from torch import Tensor

    from liftcore.features.views import ViewFeatures
    from liftcore.scene.cameras import Camera


__all__ = [
    "MOST_OF_A_RAY",
    "CompositingParams",
    "Raster",
    "RayRows",
    "RegionWeights",
    "Selection",
    "ViewRequest",
    "ViewWeights",
    "Weighting",
]


@dataclass(frozen=True)
class CompositingParams:
    """How a ray walks through the splats, front to back."""

    opacity_logit_scale: float = 1.0  # lambda: alpha~ = sigmoid(lambda theta)
    alpha_cap: float = 0.99  # the largest alpha of a splat on a ray
    transmittance_stop: float = 1e-4  # exclusive: the splat that would bring T to it or below adds nothing
    antialiased: bool = False  # the mip filter's opacity compensation, 3DGS only
    stride: int = 1  # region weights look at every n-th pixel in x and in y; renders at all of them
    offset: tuple[int, int] = (0, 0)  # the first such pixel (x, y), each below the stride


@dataclass(frozen=True)
class RegionWeights:
    """``W = A'^T S`` of one view, sparse by rows of the splats that it saw, and ``A^T 1``.

    ``A'`` holds the weights that the weighting selects, to its power; for all of them at power 1 it is A.
    """

    splats: Tensor  # [n] i32 ascending, the splats with a row
    indptr: Tensor  # [n + 1] i64, CSR row pointers
    columns: Tensor  # [nnz] i32 ascending in a row, rows of the codebook
    weights: Tensor  # [nnz] f32, sums over rays of the selected w^p times the reading S
    evidence_splats: Tensor  # [m] i32 ascending, the splats that any ray met, labelled or not
    evidence: Tensor  # [m] f32, sum of plain weights w (opacity_logit_scale 1, power 1), each ray once


@dataclass(frozen=True)
class RayRows:
    """Rows of A for single rays, sparse."""

    indptr: Tensor  # [n + 1] i64, CSR row pointers
    splats: Tensor  # [nnz] i32, near to far
    weights: Tensor  # [nnz] f32


@dataclass(frozen=True)
class ViewRequest:
    """What a lift asks of one view."""

    camera: Camera
    observation: ViewFeatures
    params: CompositingParams
    weighting: Weighting
    pixels: Tensor  # [n, 2] i32 (x, y), whose rows of A are asked for


@dataclass(frozen=True)
class ViewWeights:
    """What a lift learns of one view."""

    weights: RegionWeights
    rows: RayRows


class Raster(Protocol):
    """A for one scene. Every product is deterministic to the bit, whatever the number of threads."""

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, walk: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """``A'^T S`` of a view and the evidence of plain weights, over the rays that the walk's stride leaves."""
        ...

    def iterate_views(self, looks: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """``region_weights`` and ``ray_rows`` of many views, in their order.

        A look may be taken before the views ahead of it are done, and several views may be walked at a time. An error
        of a look or of a walk ends the iterator. No view is kept at its end: the solution has the memory.
        """
        ...

    def render(self, camera: Camera, values: Tensor, walk: CompositingParams) -> Tensor:
        """``A X``: values [P, F] f32 -> [H, W, F] f32, background zero, not divided by the row sum; never strided."""
        ...

    def adjoint(self, camera: Camera, values: Tensor, walk: CompositingParams) -> Tensor:
        """``A^T Y``: values [H, W, C] f32 -> [P, C] f32, the transpose of the render; never strided."""
        ...

    def row_sums(self, camera: Camera, walk: CompositingParams) -> Tensor:
        """``A 1``: [H, W] f32 (Property 2)."""
        ...

    def strongest_labels(self, camera: Camera, labels: Tensor, walk: CompositingParams) -> Tensor:
        """``argmax(A onehot(labels))``: labels [P] i32 in -1..K - 1 -> [H, W] i32.

        Label -1 is a class like the others; rays that miss the scene get -1 too. Equal sums go to the smallest label.
        """
        ...

    def ray_rows(self, camera: Camera, pixels: Tensor, walk: CompositingParams) -> RayRows:
        """Rows of A for the rays of pixels [n, 2] i32 (x, y) of the full view, whatever the walk's stride."""
        ...

    def forget(self) -> None:
        """Drop what is kept of the last view for its next product."""
        ...
