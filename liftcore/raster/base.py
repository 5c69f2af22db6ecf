"""The protocol of raster backends: products with A, view by view, their arguments and results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from liftcore.errors import InvalidInput
from liftcore.scene.compositing import check_antialiased

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from torch import Tensor

    from liftcore.scene.cameras import Camera
    from liftcore.scene.compositing import CompositingParams, Weighting
    from liftcore.scene.kernel import Kernel
    from liftcore.scene.splats import Splats
    from liftcore.values.region_weights import RegionWeights
    from liftcore.values.views import ViewFeatures


@dataclass(frozen=True)
class RayRows:
    """Rows of A for single rays, sparse."""

    indptr: Tensor  # [n + 1] i64, CSR row pointers
    splats: Tensor  # [nnz] i32, near to far by the CPU, in ascending order by others
    weights: Tensor  # [nnz] f32


@dataclass(frozen=True)
class ViewRequest:
    """One view to rasterize: camera, observation, compositing parameters, weighting, and rays for the diagnostics."""

    camera: Camera
    observation: ViewFeatures
    params: CompositingParams
    weighting: Weighting
    pixels: Tensor  # [n, 2] i32 (x, y), whose rows of A are returned


@dataclass(frozen=True)
class ViewWeights:
    """The region weights of one view, and the rows of A of the requested rays."""

    weights: RegionWeights
    rows: RayRows


class Raster(Protocol):
    """A for one scene. Every product is bitwise identical for any number of threads."""

    splats: Splats

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """Return ``A'^T S`` of a view and the total weight of unscaled weights, over the rays of the stride."""
        ...

    def iterate_views(self, requests: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """Yield ``region_weights`` and ``ray_rows`` of many views, in their order.

        A request may be read before earlier views are finished, and several views may be processed at a time. An
        error of a request or of its view ends the iterator. No view is cached at its end, so the solver has the
        memory.
        """
        ...

    def render(self, camera: Camera, values: Tensor, params: CompositingParams) -> Tensor:
        """Return ``A X``: values [P, F] f32 -> [H, W, F] f32, background zero, not normalised by the row sum.

        Never strided.
        """
        ...

    def row_sums(self, camera: Camera, params: CompositingParams) -> Tensor:
        """Return ``A 1``: [H, W] f32 (Property 2)."""
        ...

    def strongest_labels(self, camera: Camera, labels: Tensor, params: CompositingParams) -> Tensor:
        """Return ``argmax(A onehot(labels))``: labels [P] i32 in -1..K - 1 -> [H, W] i32.

        Label -1 is a class like the others; rays that miss the scene get -1 too. Ties go to the smallest label.
        """
        ...

    def ray_rows(self, camera: Camera, pixels: Tensor, params: CompositingParams) -> RayRows:
        """Return the rows of A for pixels [n, 2] i32 (x, y) of the full view that are rays of the stride."""
        ...

    def footprints(self, camera: Camera, params: CompositingParams) -> Tensor:
        """Return the projected area [P] f32 of each splat in the full view, px^2, before occlusion.

        It is the area of the upright ellipse in the bounding box of the splat's outline, where the outline covers
        scaled and unscaled opacities; at most the image's area, and zero where no ray of the view can hit the splat.
        """
        ...

    def forget(self) -> None:
        """Drop the cached projection of the last view."""
        ...


# Checks of arguments, shared by all backends.


def check_params(kernel: Kernel, camera: Camera, params: CompositingParams) -> None:
    """Refuse a stride that leaves no pixel, and antialiasing of a kernel that has none.

    Raises:
        InvalidInput: the stride is below one, or the offset lies outside the stride's cell or the image.
        InvalidSettings: antialiased is set for a kernel other than 3D Gaussians.
    """
    check_antialiased(kernel, params.antialiased)
    sides = (camera.width, camera.height)
    if params.stride < 1:
        raise InvalidInput("stride", expected="at least 1", got=str(params.stride))
    if not all(0 <= first < min(params.stride, side) for first, side in zip(params.offset, sides, strict=True)):
        expected = f"a pixel (x, y) of the image, each below the stride {params.stride}"
        raise InvalidInput("offset", expected=expected, got=str(params.offset))
