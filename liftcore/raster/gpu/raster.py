"""The GPU backend: A by Triton kernels, the same to the bit in every run.

Projection and tile lists are tensor operations in float64 (``projection``, ``tile_lists``); the rays are walked by
one program a tile (``walk``), whose weights a product takes as a matrix (``weighing``, ``rendering``); sums over
tiles are float64 in a fixed order (``sums``). No kernel adds to memory that another adds to. On tensors of the CPU
all of it runs in Triton's interpreter: that is how it is tested where there is no card.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from functools import wraps
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

import torch

from liftcore.device import indexed, out_of_memory
from liftcore.errors import Unavailable
from liftcore.raster.base import (
    CompositingParams,
    RayRows,
    RegionWeights,
    ViewRequest,
    ViewWeights,
    Weighting,
    check_image,
    check_labels,
    check_params,
    check_rows,
    every_pixel,
    strided_places,
)
from liftcore.raster.cpu.composite import choice_of
from liftcore.raster.cpu.project import activated, view_of, with_opacities
from liftcore.raster.cpu.weights_home import on_host
from liftcore.raster.gpu import rendering, weighing
from liftcore.raster.gpu.ahead import made_ahead
from liftcore.raster.gpu.frame import Frame
from liftcore.raster.gpu.launching import check_device
from liftcore.raster.gpu.memory import USUAL_LEVELS, raster_bytes
from liftcore.raster.gpu.projection import Projection
from liftcore.raster.gpu.room import SCENE_SHARE, room_within, scene_bytes
from liftcore.raster.gpu.scene import scene_on, with_opacity
from liftcore.raster.gpu.slots import DeviceReading
from liftcore.raster.gpu.tracing import ray_rows

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from torch import Tensor

    from liftcore.features.views import ViewFeatures
    from liftcore.raster.gpu.scene import DeviceScene
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


LEAST_FREE = 1 << 24  # bytes: a product that does not fit into pieces for so few fits into none


def _within_memory(product: Callable[Concatenate[GpuRaster, Arguments], Result]) -> Callable[..., Result]:
    """A product that is made again in smaller pieces when the device's memory runs out, and at last says so in words.

    No bit depends on the pieces, so it matters to nobody how often that was.
    """

    @wraps(product)
    def guarded(self: GpuRaster, *arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        while True:
            try:
                return product(self, *arguments, **named)
            except RuntimeError as error:
                if not out_of_memory(error):
                    raise
                told = str(error).splitlines()[0] if str(error) else type(error).__name__
            if not self.take_less():  # out here the error no longer holds what the product held
                raise Unavailable(
                    "device",
                    expected="a GPU with free memory for the footprints and lists of a row of tiles",
                    got=told,
                    hint="free memory on the device, lower the images' resolution, or take the device cpu",
                )

    return guarded


class GpuRaster:
    """A for one scene, of any kernel (``liftcore.raster.base.Raster``). Tensors come and go on the CPU.

    One call at a time: the view at hand is kept for the next product.

    Args:
        splats: the scene.
        device: a CUDA device; the CPU where Triton's interpreter is on.
        free: bytes that may be taken there; None for no limit. What does not fit is cut, and no bit depends on it.
        stays: whether region weights stay on the device where they fit, for a solution there.

    Raises:
        Unavailable: the device cannot run the kernels.
    """

    def __init__(self, splats: Splats, device: torch.device, free: int | None = None, *, stays: bool = False) -> None:
        check_device(device)
        self.splats = splats
        self.device = indexed(device)
        self._free, self._stays = free, stays
        self._host = activated(splats, 1.0)
        self._size = scene_bytes(splats.count, splats.kernel)
        self._gain = 1.0  # of the scene
        self._scene: DeviceScene | None = None
        self._kept: tuple[Camera, CompositingParams, Frame] | None = None

    def take_less(self) -> bool:
        """Let go of everything and cut the work for half of the memory; False where it cannot be cut any more."""
        free = raster_bytes(self.splats.count, 1, 1, self.splats.kernel, 1) if self._free is None else self._free
        if free <= LEAST_FREE:
            return False
        self._free, self._scene, self._kept = free // 2, None, None
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        return True

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """``A'^T S`` of a view and the evidence of plain weights. See the protocol."""
        return self._brought(self._weighed(self._read(observation, camera, params), camera, params, weighting))

    @_within_memory
    def _weighed(
        self, reading: DeviceReading, camera: Camera, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        choice, frame = choice_of(weighting), self._frame(camera, params, reading.levels)
        return weighing.region_weights(frame, reading, choice, params.opacity_logit_scale != 1.0, self.splats.count)

    def _brought(self, weights: RegionWeights) -> RegionWeights:
        """Where they are wanted. A host without room for them is no reason for smaller pieces on the device."""
        return weights if self._stays else on_host(weights)

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
        image = torch.empty(camera.height, camera.width, values.shape[1])
        for begin in range(0, values.shape[1], rendering.WIDEST):
            block = values[:, begin : begin + rendering.WIDEST].to(torch.float32).contiguous()
            image[:, :, begin : begin + rendering.WIDEST] = rendering.render(frame, block)
        return image

    @_within_memory
    def adjoint(self, camera: Camera, values: Tensor, params: CompositingParams) -> Tensor:
        """``A^T Y``: values [H, W, C] f32 -> [P, C] f32. See the protocol."""
        check_image(values, camera)
        frame = self._frame(camera, every_pixel(params))
        result = torch.empty(self.splats.count, values.shape[2])
        for begin in range(0, values.shape[2], weighing.WIDEST):
            block = values[:, :, begin : begin + weighing.WIDEST]
            result[:, begin : begin + weighing.WIDEST] = weighing.adjoint(frame, block, self.splats.count)
        return result

    def row_sums(self, camera: Camera, params: CompositingParams) -> Tensor:
        """``A 1``: [H, W] f32."""
        return self.render(camera, torch.ones(self.splats.count, 1), params)[:, :, 0]

    @_within_memory
    def strongest_labels(self, camera: Camera, labels: Tensor, params: CompositingParams) -> Tensor:
        """``argmax(A onehot(labels))``: labels [P] i32 in -1..K - 1 -> [H, W] i32. See the protocol."""
        check_labels(labels, self.splats.count)
        frame = self._frame(camera, every_pixel(params))
        return rendering.strongest_labels(frame, labels.to(torch.int32)).cpu()

    @_within_memory
    def ray_rows(self, camera: Camera, pixels: Tensor, params: CompositingParams) -> RayRows:
        """Rows of A for single pixels [n, 2] (x, y). See the protocol."""
        places = strided_places(params, pixels)
        if places is None:  # not all of them are rays of the strided view
            places, params = pixels, every_pixel(params)
        return ray_rows(self._frame(camera, params), places)

    def forget(self) -> None:
        """Drop the projected view that is kept for the next product."""
        self._kept = None

    def _frame(self, camera: Camera, params: CompositingParams, levels: int = USUAL_LEVELS) -> Frame:
        """The view projected, with room for labels of so many levels; the last one is kept."""
        if self._kept is not None and self._kept[0] is camera and self._kept[1] == params:
            return self._kept[2]
        check_params(self.splats.kernel, camera, params)
        self._kept = None  # before, so that one frame's memory is the most ever held
        view = view_of(camera, params)
        levels = max(levels, USUAL_LEVELS)  # one level may stand for tuples of several, and has as many sums
        need = raster_bytes(self.splats.count, view.width, view.height, self.splats.kernel, levels)
        room = room_within(self._free, self.splats.kernel, need)
        scene = self._scene_with(params.opacity_logit_scale)
        projection = Projection(scene, view, self.splats.kernel, params.antialiased, self.device, room.splats)
        frame = Frame(projection, params, room)
        self._kept = camera, params, frame
        return frame

    def _scene_with(self, gain: float) -> DeviceScene:
        """The splats with that gain on their opacity: on the device, or on the host where they would fill it."""
        if gain != self._gain:
            self._host, self._gain = with_opacities(self._host, self.splats, gain), gain
            self._scene = None if self._scene is None else with_opacity(self._scene, self._host)
        if self._scene is None:
            staged = self._free is not None and self._size > SCENE_SHARE * self._free
            self._scene = scene_on(torch.device("cpu") if staged else self.device, self._host)
        return self._scene
