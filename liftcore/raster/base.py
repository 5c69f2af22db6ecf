"""What a raster backend offers: the uses of A, view by view, and the values that it takes and gives."""

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

    splats: Splats

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """``A'^T S`` of a view and the total weight of plain weights, over the rays that the stride leaves."""
        ...

    def iterate_views(self, requests: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """``region_weights`` and ``ray_rows`` of many views, in their order.

        A request may be taken before the views ahead of it are done, and several views may be in work at a time. An
        error of a request or of its view ends the iterator. No view is kept at its end: the solution has the memory.
        """
        ...

    def render(self, camera: Camera, values: Tensor, params: CompositingParams) -> Tensor:
        """``A X``: values [P, F] f32 -> [H, W, F] f32, background zero, not divided by the row sum; never strided."""
        ...

    def adjoint(self, camera: Camera, values: Tensor, params: CompositingParams) -> Tensor:
        """``A^T Y``: values [H, W, C] f32 -> [P, C] f32, the transpose of the render; never strided."""
        ...

    def row_sums(self, camera: Camera, params: CompositingParams) -> Tensor:
        """``A 1``: [H, W] f32 (Property 2)."""
        ...

    def strongest_labels(self, camera: Camera, labels: Tensor, params: CompositingParams) -> Tensor:
        """``argmax(A onehot(labels))``: labels [P] i32 in -1..K - 1 -> [H, W] i32.

        Label -1 is a class like the others; rays that miss the scene get -1 too. Equal sums go to the smallest label.
        """
        ...

    def ray_rows(self, camera: Camera, pixels: Tensor, params: CompositingParams) -> RayRows:
        """Rows of A for the rays of pixels [n, 2] i32 (x, y) of the full view, whatever the stride."""
        ...

    def footprints(self, camera: Camera, params: CompositingParams) -> Tensor:
        """Areas [P] f32 that splats may show in the whole view, px^2, at most the image's, before occlusion.

        That of the upright ellipse which spans the same box as the splat's outline, with the opacity's scale and
        without it; zero where no ray of the view can meet the splat.
        """
        ...

    def forget(self) -> None:
        """Drop what is kept of the last view for its next product."""
        ...


# What every backend asks of its arguments, in one set of words.


def check_params(kernel: Kernel, camera: Camera, params: CompositingParams) -> None:
    """Refuse a stride that leaves no pixel, and compensation where it has no meaning.

    Raises:
        InvalidInput: a stride below one, or a first pixel outside its cell or the image.
        InvalidSettings: antialiased splats that are no 3D Gaussians.
    """
    check_antialiased(kernel, params.antialiased)
    sides = (camera.width, camera.height)
    if params.stride < 1:
        raise InvalidInput("stride", expected="at least 1", got=str(params.stride))
    if not all(0 <= first < min(params.stride, side) for first, side in zip(params.offset, sides, strict=True)):
        expected = f"a pixel of the image below the stride {params.stride}"
        raise InvalidInput("offset", expected=expected, got=str(params.offset))


def check_rows(values: Tensor, splats: int) -> None:
    """Refuse values that are not [P, C] (InvalidInput)."""
    if values.ndim != 2 or values.shape[0] != splats:
        raise InvalidInput("values", expected=f"one row for each of {splats} splats", got=f"{list(values.shape)}")


def check_image(values: Tensor, camera: Camera) -> None:
    """Refuse values that are not [H, W, C] (InvalidInput)."""
    if values.ndim != 3 or values.shape[:2] != (camera.height, camera.width):
        expected = f"an image of {camera.height} rows of {camera.width} pixels"
        raise InvalidInput("values", expected=expected, got=f"{list(values.shape)}")


def check_labels(labels: Tensor, splats: int) -> None:
    """Refuse labels that are not [P], -1 or more (InvalidInput)."""
    if labels.ndim != 1 or labels.shape[0] != splats or int(labels.min()) < -1:
        got = f"{list(labels.shape)}, the smallest {int(labels.min())}"
        raise InvalidInput("labels", expected=f"a label of -1 or more for each of {splats} splats", got=got)


def strided_places(params: CompositingParams, pixels: Tensor) -> Tensor | None:
    """The pixels [n, 2] (x, y) as pixels of the strided view; None when some are not among its rays."""
    if params.stride == 1:
        return pixels
    steps = pixels - pixels.new_tensor(params.offset)
    return None if bool((steps % params.stride).any()) else steps // params.stride
