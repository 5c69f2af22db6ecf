"""The GPU backend: A by Triton kernels, the same to the bit in every run.

Projection and tile lists are tensor operations in float64 (``project``, ``tiles``), but for the tile columns of a
splat, which a kernel finds. One program a tile composites its rays (``composite``), and a product takes the weights
as a matrix (``weights``, ``render``). Sums over tiles are float64 in a fixed order. No kernel adds to memory that
another adds to. On tensors of the CPU it runs in Triton's interpreter: so it is tested where there is no card.
"""

import math
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from contextvars import copy_context
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

import torch
from torch import Tensor

from liftcore.errors import Unavailable
from liftcore.raster.base import (
    RayRows,
    ViewRequest,
    ViewWeights,
    check_image,
    check_labels,
    check_params,
    check_rows,
    strided_places,
)
from liftcore.raster.cpu.composite import choice_of
from liftcore.raster.cpu.project import activated, view_of, with_opacities
from liftcore.raster.gpu import render, weights
from liftcore.raster.gpu.launching import check_device
from liftcore.raster.gpu.project import DeviceScene, project, scene_on, with_opacity
from liftcore.raster.gpu.render import ray_rows
from liftcore.raster.gpu.tiles import BLOCK, Frame
from liftcore.raster.gpu.weights import DeviceReading
from liftcore.runtime.device import indexed, out_of_memory
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams, Weighting, every_pixel
from liftcore.scene.splats import Splats
from liftcore.values.region_weights import RegionWeights
from liftcore.values.views import ViewFeatures

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Item = TypeVar("Item")
Made = TypeVar("Made")

LEAST_BLOCK = 1 << 14  # items: a product that does not fit in blocks of so few fits into none


def _within_memory(product: Callable[Concatenate["GpuRaster", Arguments], Result]) -> Callable[..., Result]:
    """A product that is made again in blocks of half the size when the device's memory runs out.

    No bit depends on the block, so it matters to nobody how often that was.
    """

    @wraps(product)
    def guarded(self: "GpuRaster", *arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        while True:
            try:
                return product(self, *arguments, **named)
            except RuntimeError as error:
                if not out_of_memory(error):
                    raise
                told = str(error).splitlines()[0] if str(error) else type(error).__name__
            if not self.halve_block():  # out here the error no longer holds what the product held
                raise Unavailable(
                    "device",
                    expected="a GPU with free memory for the scene, and for the projected splats and lists of a view",
                    got=told,
                    hint="free memory on the device, lower the images' resolution, or take the device cpu",
                )

    return guarded


class GpuRaster:
    """A for one scene, of any kernel (``liftcore.raster.base.Raster``). Tensors come and go on the CPU.

    One call at a time: the view at hand is kept for the next product.

    Args:
        splats: the scene; it lies whole on the device, about 110 bytes a splat.
        device: a CUDA device; the CPU where Triton's interpreter is on.
        block: items of tile lists that are held at a time. It is halved where memory runs out; no bit depends on it.
        stays: whether region weights stay on the device, for a solution there.

    Raises:
        Unavailable: the device cannot run the kernels.
    """

    def __init__(self, splats: Splats, device: torch.device, block: int = BLOCK, *, stays: bool = False) -> None:
        check_device(device)
        self.splats = splats
        self.device = indexed(device)
        self._block, self._stays = block, stays
        self._host = activated(splats, 1.0)
        self._scale = 1.0  # on the opacity logits of the scene
        self._scene: DeviceScene | None = None
        self._kept: tuple[Camera, CompositingParams, Frame] | None = None

    def halve_block(self) -> bool:
        """Let go of everything and cut the work into blocks of half the size; False where they are the least."""
        self._scene = self._kept = None
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        if self._block <= LEAST_BLOCK:
            return False
        self._block //= 2
        return True

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """``A'^T S`` of a view and the total weight of plain weights. See the protocol."""
        return self._brought(self._weighed(self._read(observation, camera, params), camera, params, weighting))

    @_within_memory
    def _weighed(
        self, reading: DeviceReading, camera: Camera, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        choice, frame = choice_of(weighting), self._frame(camera, params)
        return weights.region_weights(frame, reading, choice, params.opacity_logit_scale != 1.0, self.splats.count)

    def _brought(self, weights: RegionWeights) -> RegionWeights:
        """Where they are wanted. A host without room for them is no reason for smaller pieces on the device."""
        return weights if self._stays else weights.cpu()

    def iterate_views(self, requests: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """``region_weights`` and ``ray_rows`` of views, one at a time; the next one is read while the card walks."""

        def read(request: ViewRequest) -> DeviceReading:
            return self._read(request.observation, request.camera, request.params)

        try:
            with closing(made_ahead(requests, read)) as ahead:
                for request, reading in ahead:
                    yield ViewWeights(  # without a name, which would hold it beside the next one
                        self._brought(self._weighed(reading, request.camera, request.params, request.weighting)),
                        self.ray_rows(request.camera, request.pixels, request.params),
                    )
        finally:
            self.forget()

    def _read(self, observation: ViewFeatures, camera: Camera, params: CompositingParams) -> DeviceReading:
        check_params(self.splats.kernel, camera, params)
        return DeviceReading(observation, camera, params, self.device)

    @_within_memory
    def render(self, camera: Camera, values: Tensor, params: CompositingParams) -> Tensor:
        """``A X``: values [P, C] f32 -> [H, W, C] f32. See the protocol."""
        check_rows(values, self.splats.count)
        frame = self._frame(camera, every_pixel(params))
        image = torch.empty(camera.height, camera.width, values.shape[1], dtype=torch.float32)
        for begin in range(0, values.shape[1], render.WIDEST):
            block = values[:, begin : begin + render.WIDEST].to(torch.float32).contiguous()
            image[:, :, begin : begin + render.WIDEST] = render.render(frame, block)
        return image

    @_within_memory
    def adjoint(self, camera: Camera, values: Tensor, params: CompositingParams) -> Tensor:
        """``A^T Y``: values [H, W, C] f32 -> [P, C] f32. See the protocol."""
        check_image(values, camera)
        frame = self._frame(camera, every_pixel(params))
        result = torch.empty(self.splats.count, values.shape[2], dtype=torch.float32)
        for begin in range(0, values.shape[2], weights.WIDEST):
            block = values[:, :, begin : begin + weights.WIDEST]
            result[:, begin : begin + weights.WIDEST] = weights.adjoint(frame, block, self.splats.count)
        return result

    def row_sums(self, camera: Camera, params: CompositingParams) -> Tensor:
        """``A 1``: [H, W] f32."""
        return self.render(camera, torch.ones(self.splats.count, 1, dtype=torch.float32), params)[:, :, 0]

    @_within_memory
    def strongest_labels(self, camera: Camera, labels: Tensor, params: CompositingParams) -> Tensor:
        """``argmax(A onehot(labels))``: labels [P] i32 in -1..K - 1 -> [H, W] i32. See the protocol."""
        check_labels(labels, self.splats.count)
        frame = self._frame(camera, every_pixel(params))
        return render.strongest_labels(frame, labels.to(torch.int32)).cpu()

    @_within_memory
    def ray_rows(self, camera: Camera, pixels: Tensor, params: CompositingParams) -> RayRows:
        """Rows of A for single pixels [n, 2] (x, y). See the protocol."""
        places = strided_places(params, pixels)
        if places is None:  # not all of them are rays of the strided view
            places, params = pixels, every_pixel(params)
        return ray_rows(self._frame(camera, params), places)

    @_within_memory
    def footprints(self, camera: Camera, params: CompositingParams) -> Tensor:
        """Areas of the splats' outlines, [P] f32, on the CPU. See the protocol."""
        check_params(self.splats.kernel, camera, params)
        scene = self._scene_with(params.opacity_logit_scale)
        view = view_of(camera, every_pixel(params), self.splats.origin)
        seen = project(scene, view, self.splats.kernel, params.antialiased, max(1, self._block >> 4))
        outlines = math.pi * seen.outlines.extent_x * seen.outlines.extent_y
        least, most = torch.finfo(torch.float32).tiny, camera.width * camera.height
        areas = torch.zeros(self.splats.count, dtype=torch.float32, device=self.device)
        areas[seen.ids.long()] = outlines.clamp(least, most).float()
        return areas.cpu()

    def forget(self) -> None:
        """Drop the projected view that is kept for the next product."""
        self._kept = None

    def _frame(self, camera: Camera, params: CompositingParams) -> Frame:
        """The view projected; the last one is kept."""
        if self._kept is not None and self._kept[0] is camera and self._kept[1] == params:
            return self._kept[2]
        check_params(self.splats.kernel, camera, params)
        self._kept = None  # before, so that one frame's memory is the most ever held
        scene = self._scene_with(params.opacity_logit_scale)
        frame = Frame(scene, view_of(camera, params, self.splats.origin), self.splats.kernel, params, self._block)
        self._kept = camera, params, frame
        return frame

    def _scene_with(self, scale: float) -> DeviceScene:
        """The splats on the device, with that scale on their opacity logits."""
        if scale != self._scale:
            self._host, self._scale = with_opacities(self._host, self.splats, scale), scale
            self._scene = None if self._scene is None else with_opacity(self._scene, self._host)
        if self._scene is None:
            self._scene = scene_on(self.device, self._host)
        return self._scene


def made_ahead(items: Iterable[Item], make: Callable[[Item], Made]) -> Generator[tuple[Item, Made]]:
    """Every item and what is made of it, in their order; a thread takes and makes the next one meanwhile.

    Raises:
        Exception: what the items or ``make`` raise, in their turn.
    """
    source = iter(items)

    def following() -> tuple[Item, Made] | None:
        for item in source:
            return item, make(item)
        return None

    context = copy_context()  # of the caller, whose code may be among the items
    with ThreadPoolExecutor(1, "view-ahead") as pool:
        waiting = pool.submit(context.run, following)
        while (found := waiting.result()) is not None:
            waiting = pool.submit(context.run, following)
            yield found
