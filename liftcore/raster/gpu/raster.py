"""The GPU backend: A by Triton kernels, bitwise identical in every run.

Projection and tile lists are float64 tensor operations (``project``, ``tiles``), except for the tile columns of a
splat, which a kernel computes. One program per tile composites its rays (``composite``), and the product loads the
weights as a matrix (``weights``). Sums over tiles are float64 in a fixed order. No two programs add to the same
memory. The CPU makes pictures. On CPU tensors it runs in Triton's interpreter, for tests without a GPU.
"""

import math
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from contextvars import copy_context
from functools import cached_property, wraps
from typing import Concatenate, ParamSpec, TypeVar

import torch
from torch import Tensor

from liftcore.errors import Unavailable
from liftcore.raster.base import (
    RayRows,
    ViewRequest,
    ViewWeights,
    check_params,
    strided_places,
)
from liftcore.raster.cpu.project import activate_splats, view_of, with_opacities
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.gpu import weights
from liftcore.raster.gpu.launching import check_device
from liftcore.raster.gpu.project import DeviceScene, project, scene_on, with_opacity
from liftcore.raster.gpu.rays import ray_rows
from liftcore.raster.gpu.tiles import BLOCK, Frame
from liftcore.raster.gpu.weights import DeviceReading
from liftcore.runtime.device import indexed, out_of_memory
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams, Weighting, check_weighting, every_pixel
from liftcore.scene.splats import Splats
from liftcore.values.region_weights import RegionWeights
from liftcore.values.views import ViewFeatures

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Item = TypeVar("Item")
Output = TypeVar("Output")

LEAST_BLOCK = 1 << 14  # items: the smallest block that is tried


def _within_memory(product: Callable[Concatenate["GpuRaster", Arguments], Result]) -> Callable[..., Result]:
    """Decorate a product to retry with blocks of half the size when the device's memory runs out.

    The result is bitwise identical for any block.
    """

    @wraps(product)
    def run_within_memory(self: "GpuRaster", *arguments: Arguments.args, **keywords: Arguments.kwargs) -> Result:
        while True:
            try:
                return product(self, *arguments, **keywords)
            except RuntimeError as error:
                if not out_of_memory(error):
                    raise
                message = str(error).splitlines()[0] if str(error) else type(error).__name__
            if not self.halve_block():  # outside the except clause, whose error keeps the product's tensors alive
                raise Unavailable(
                    "device",
                    expected="a GPU with free memory for the scene and the projected splats and tile lists of a view",
                    got=message,
                    hint="free memory on the device, lower the images' resolution, or use device='cpu'",
                )

    return run_within_memory


class GpuRaster:
    """A for one scene, of any kernel (``liftcore.raster.base.Raster``). Arguments and results are CPU tensors.

    One call at a time: the projection of the last view is cached for the next product.

    Args:
        splats: the scene; it is copied to the device, about 110 bytes per splat.
        device: a CUDA device; the CPU if Triton's interpreter is on.
        block: items of tile lists in memory at a time, halved where memory runs out. The result is bitwise identical
            for any value.

    Raises:
        Unavailable: the device cannot run the kernels.
    """

    def __init__(self, splats: Splats, device: torch.device, block: int = BLOCK) -> None:
        check_device(device)
        self.splats = splats
        self.device = indexed(device)
        self._block = block
        self._host = activate_splats(splats, 1.0)
        self._scale = 1.0  # of the scene's opacity logits
        self._scene: DeviceScene | None = None
        self._last_view: tuple[Camera, CompositingParams, Frame] | None = None

    def halve_block(self) -> bool:
        """Free all device memory and halve the block; return False if the block is already the smallest."""
        self._scene = self._last_view = None
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        if self._block <= LEAST_BLOCK:
            return False
        self._block //= 2
        return True

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """Return ``A'^T S`` of a view and the total weight of unscaled weights. See the protocol."""
        # Copied outside of the function that retries: smaller blocks do not help a host without memory.
        return self._view_weights(self._read(observation, camera, params), camera, params, weighting).cpu()

    @_within_memory
    def _view_weights(
        self, reading: DeviceReading, camera: Camera, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        check_weighting(weighting)
        frame = self._frame(camera, params)
        return weights.region_weights(frame, reading, weighting, params.opacity_logit_scale != 1.0, self.splats.count)

    def iterate_views(self, requests: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """Yield ``region_weights`` and ``ray_rows`` of views, one at a time; the next is read while the GPU works."""

        def read(request: ViewRequest) -> DeviceReading:
            return self._read(request.observation, request.camera, request.params)

        try:
            with closing(prefetch(requests, read)) as views:
                for request, reading in views:
                    yield ViewWeights(  # not bound to a name, which would keep it in memory with the next one
                        self._view_weights(reading, request.camera, request.params, request.weighting).cpu(),
                        self.ray_rows(request.camera, request.pixels, request.params),
                    )
        finally:
            self.forget()

    def _read(self, observation: ViewFeatures, camera: Camera, params: CompositingParams) -> DeviceReading:
        check_params(self.splats.kernel, camera, params)
        return DeviceReading(observation, camera, params, self.device)

    def render(self, camera: Camera, values: Tensor, params: CompositingParams) -> Tensor:
        """Return ``A X``: values [P, C] f32 -> [H, W, C] f32, by the CPU. See the protocol."""
        return self._pictures.render(camera, values, params)

    def row_sums(self, camera: Camera, params: CompositingParams) -> Tensor:
        """Return ``A 1``: [H, W] f32, by the CPU."""
        return self._pictures.row_sums(camera, params)

    def strongest_labels(self, camera: Camera, labels: Tensor, params: CompositingParams) -> Tensor:
        """Return ``argmax(A onehot(labels))`` [H, W] i32, by the CPU. See the protocol."""
        return self._pictures.strongest_labels(camera, labels, params)

    @cached_property
    def _pictures(self) -> CpuRaster:
        return CpuRaster(self.splats)

    @_within_memory
    def ray_rows(self, camera: Camera, pixels: Tensor, params: CompositingParams) -> RayRows:
        """Return rows of A for single pixels [n, 2] (x, y). See the protocol."""
        places = strided_places(params, pixels)
        if places is None:  # some are no rays of the strided view
            places, params = pixels, every_pixel(params)
        return ray_rows(self._frame(camera, params), places)

    @_within_memory
    def footprints(self, camera: Camera, params: CompositingParams) -> Tensor:
        """Return the areas [P] f32 of the splats' outlines, on the CPU. See the protocol."""
        check_params(self.splats.kernel, camera, params)
        scene = self._scene_with(params.opacity_logit_scale)
        view = view_of(camera, every_pixel(params), self.splats.origin)
        projected = project(scene, view, self.splats.kernel, params.antialiased, max(1, self._block >> 4))
        outlines = math.pi * projected.outlines.extent_x * projected.outlines.extent_y
        smallest, largest = torch.finfo(torch.float32).tiny, camera.width * camera.height
        areas = torch.zeros(self.splats.count, dtype=torch.float32, device=self.device)
        areas[projected.ids.long()] = outlines.clamp(smallest, largest).float()
        return areas.cpu()

    def forget(self) -> None:
        """Drop the cached projection of the last view."""
        self._last_view = None

    def _frame(self, camera: Camera, params: CompositingParams) -> Frame:
        """Project the view; the last view is cached."""
        if self._last_view is not None and self._last_view[0] is camera and self._last_view[1] == params:
            return self._last_view[2]
        check_params(self.splats.kernel, camera, params)
        self._last_view = None  # first, so that at most one view is in memory
        scene = self._scene_with(params.opacity_logit_scale)
        frame = Frame(scene, view_of(camera, params, self.splats.origin), self.splats.kernel, params, self._block)
        self._last_view = camera, params, frame
        return frame

    def _scene_with(self, scale: float) -> DeviceScene:
        """Return the splats on the device, with this scale of their opacity logits."""
        if scale != self._scale:
            self._host, self._scale = with_opacities(self._host, self.splats, scale), scale
            self._scene = None if self._scene is None else with_opacity(self._scene, self._host)
        if self._scene is None:
            self._scene = scene_on(self.device, self._host)
        return self._scene


def prefetch(items: Iterable[Item], make: Callable[[Item], Output]) -> Generator[tuple[Item, Output]]:
    """Yield every item and ``make(item)``, in order, while a thread prepares the next one.

    Raises:
        Exception: an error of the iterator or of ``make``, raised at its item.
    """
    source = iter(items)

    def following() -> tuple[Item, Output] | None:
        for item in source:
            return item, make(item)
        return None

    context = copy_context()  # of the caller, as the iterator may be the caller's code
    with ThreadPoolExecutor(1, "view-ahead") as pool:
        waiting = pool.submit(context.run, following)
        while (result := waiting.result()) is not None:
            waiting = pool.submit(context.run, following)
            yield result
