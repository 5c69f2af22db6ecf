"""The weights A without a lift: region weights ``A^T S``, renders ``A X``, and rows of A."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidCameras, InvalidSettings
from liftcore.lifting.geometry import weigh_views
from liftcore.lifting.inputs import LiftInputs
from liftcore.raster import check_splats_and_threads, open_raster
from liftcore.raster.base import Raster
from liftcore.runtime.device import CPU, choose_device
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, shown_progress
from liftcore.runtime.torch_modes import callers_modes, default_modes
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.compositing import CompositingParams, check_antialiased
from liftcore.scene.splats import Splats, shared_tensor
from liftcore.values.lift_views import ViewValues
from liftcore.values.region_weights import RegionWeights
from liftcore.values.settings import LiftSettings, Preset


@default_modes()
def render(
    splats: Splats,
    camera: Camera,
    values: Tensor | np.ndarray,
    params: CompositingParams | None = None,
    *,
    normalise: bool = False,
    threads: int | None = None,
) -> Tensor:
    """Composite values on splats front to back, as a rasterizer does colours: ``A X``.

    Args:
        values: [P] or [P, F] of any numbers or booleans, a row a splat, in the splats' order; without gradients.
        params: of compositing; None: those of the splats' training (`Splats.antialiased`), with the usual constants.
            The scale of the opacity logits is 1; the background is zero.
        normalise: True divides pixels by the sum of their weights, where it is not zero.
        threads: None uses all cores; the result is bitwise identical for any number.

    Returns:
        [H, W] or [H, W, F] f32, on the CPU.

    Raises:
        InvalidSplats, InvalidCameras: splats or camera are of another type, such as a path or a name.
        InvalidSettings: values have another number of rows than there are splats, or a gradient, or threads are no
            number.
    """
    raster, params = _open_view(splats, camera, params, threads)
    rows = _rows(raster.splats, values)
    image = raster.render(camera, rows if rows.ndim == 2 else rows[:, None], params)
    if normalise:
        sums = raster.row_sums(camera, params)[:, :, None]
        image = torch.where(sums > 0, image / sums.clamp_min(torch.finfo(torch.float32).tiny), 0.0)
    return image if rows.ndim == 2 else image[:, :, 0]


@default_modes()
def weights_at(
    splats: Splats,
    camera: Camera,
    pixels: Tensor | np.ndarray | Sequence[tuple[int, int]],
    params: CompositingParams | None = None,
    *,
    threads: int | None = None,
) -> list[tuple[Tensor, Tensor]]:
    """Find the splats that make pixels, with their weights: the entries of rows of A that are not zero.

    The weights of a pixel multiply the colours of its splats; what they leave of 1 is background.

    Args:
        pixels: [n, 2] integers (x, y), from 0 at the top left. params, threads: as in `render`.

    Returns:
        A pair for each pixel, in their order: numbers of splats [k] i64, near to far, and their weights [k] f32, on
        the CPU.

    Raises:
        InvalidSplats, InvalidCameras: as in `render`.
        InvalidSettings: pixels are no pairs of integers, or lie outside the image; or threads are no number.
    """
    raster, params = _open_view(splats, camera, params, threads)
    try:
        places, size = np.asarray(pixels), (camera.width, camera.height)
    except (TypeError, ValueError) as error:  # ragged lists, tensors of a GPU
        expected = "integers [n, 2], the x and y of each pixel"
        raise InvalidSettings("pixels", expected=expected, got=str(error).splitlines()[0]) from None
    if places.ndim != 2 or places.shape[1] != 2 or not np.issubdtype(places.dtype, np.integer):
        got = f"{places.dtype} {list(places.shape)}"
        raise InvalidSettings("pixels", expected="integers [n, 2], the x and y of each pixel", got=got)
    outside = places[((places < 0) | (places >= size)).any(axis=1)]
    if outside.size:
        expected = f"pixels (x, y) of an image of {camera.width} x {camera.height}"
        raise InvalidSettings("pixels", expected=expected, got=str(tuple(outside[0].tolist())))
    rows = raster.ray_rows(camera, torch.from_numpy(places.astype(np.int32)), params)
    counts = rows.indptr.diff().tolist()
    return list(zip(rows.splats.long().split(counts), rows.weights.split(counts), strict=True))


def _open_view(
    splats: Splats, camera: Camera, params: CompositingParams | None, threads: int | None
) -> tuple[Raster, CompositingParams]:
    """Check the arguments of `render`, and return the raster of the splats with the parameters of compositing."""
    splats = check_splats_and_threads(splats, threads)
    params = CompositingParams(antialiased=splats.antialiased) if params is None else params
    if not isinstance(params, CompositingParams):
        raise InvalidSettings("params", expected="CompositingParams, or None", got=repr(params)[:80])
    check_antialiased(splats.kernel, params.antialiased)
    if not isinstance(camera, Camera):
        got, hint = repr(camera)[:80], "cameras[name] is the camera of a view"
        raise InvalidCameras("camera", expected="a Camera", got=got, hint=hint)
    return open_raster(splats, CPU, threads), params


def _rows(splats: Splats, values: Tensor | np.ndarray) -> Tensor:
    """Return values as f32 on the CPU, a row a splat.

    Raises:
        InvalidSettings: they are not numeric, have another number of rows, or would record a gradient.
    """
    _refuse_gradients(values)
    try:
        rows = shared_tensor(values).cpu()
    except (TypeError, ValueError) as error:
        got = f"{type(values).__name__} ({error})"[:120]
        raise InvalidSettings("values", expected="numbers or booleans of splats", got=got) from None
    if rows.ndim not in (1, 2) or rows.shape[0] != splats.count or rows.is_complex():
        expected = f"real numbers [{splats.count}] or [{splats.count}, F], a row a splat"
        got = f"{str(rows.dtype).removeprefix('torch.')} {list(rows.shape)}"
        raise InvalidSettings("values", expected=expected, got=got)
    return rows.float()


def _refuse_gradients(values: Tensor | np.ndarray) -> None:
    with callers_modes():
        recorded = torch.is_grad_enabled()
    if recorded and isinstance(values, Tensor) and values.requires_grad:
        hint = (
            "give values.detach(), or render in torch.no_grad(); A itself, to differentiate through, is "
            "region_weights(...) of a label a pixel"
        )
        raise InvalidSettings("values", expected="numbers without a gradient", got="requires_grad=True", hint=hint)


@default_modes()
def region_weights(
    splats: Splats,
    cameras: Cameras | Mapping[str, Camera],
    views: ViewValues,
    preset: Preset | str | LiftSettings = Preset.DEFAULT,
    *,
    progress: Progress | bool | None = None,
    threads: int | None = None,
    **settings: Any,
) -> RegionWeights:
    """Compute the weight of each region, or cell of a grid, of each view at each splat: ``W = A^T S``.

    Where each pixel of a view has a label of its own, S is the identity and W is the transpose of A: a column of W
    holds the weight of each splat on the ray of one pixel.

    Args:
        splats, cameras, views, preset, progress, threads, settings: as in `lift`. All views count, whatever the
            settings' coverage. A label on several levels is one region a level.

    Returns:
        W on the CPU, a row a splat, by geometry alone, which reads no feature: in memory, or in mapped files if it is
        large. With E the views' codebooks, ``W E`` over the sums of rows of W are the features of ``row-sum``.

    Raises:
        InvalidFeatures, InvalidSettings, Unavailable: as in `lift`.
    """
    inputs = LiftInputs.of(splats, cameras, views, preset, {**settings, "diagnostic_rays": 0}, threads)
    raster = open_raster(inputs.splats, choose_device(inputs.settings.device), threads)
    arguments = raster, inputs.splats.count, inputs.views, inputs.settings
    with shown_progress(progress) as reporter, one_thread():
        W = weigh_views(*arguments, reporter, by_rows=True, threads=threads).weights.cpu()
    return replace(W, total_weight=W.total_weight.float())
