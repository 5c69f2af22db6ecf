"""The GPU backend: A by Triton kernels, the same to the bit in every run.

Projection and tile lists are tensor operations in float64 (``projection``, ``tile_lists``); the rays are walked by
one program a tile (``walk``), whose weights a product takes as a matrix (``weighing``, ``rendering``); sums over
tiles are float64 in a fixed order (``sums``). No kernel adds to memory that another adds to. On tensors of the CPU
all of it runs in Triton's interpreter: that is how it is tested where there is no card.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np
import torch

from liftcore.errors import Unavailable
from liftcore.raster.antialiased import check_antialiased
from liftcore.raster.arguments import check_image, check_labels, check_rows
from liftcore.raster.constants import TILE
from liftcore.raster.gpu import rendering, weighing
from liftcore.raster.gpu.frame import Frame, tile_runs
from liftcore.raster.gpu.launching import check_device
from liftcore.raster.gpu.scene import scene_on, with_opacity
from liftcore.raster.gpu.selecting import largest_weights
from liftcore.raster.gpu.slots import DeviceReading
from liftcore.raster.gpu.tracing import ray_rows
from liftcore.raster.kernels import activated, with_gain
from liftcore.raster.projection import view_of
from liftcore.raster.protocol import RayRows, RegionWeights, Walk, Weighting
from liftcore.raster.selection import choice_of
from liftcore.raster.strided import check_stride, every_pixel, places_on, strided

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.observe.observation import Observation
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def _within_memory(product: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """A product that says in words when the device's memory is too small for it."""

    @wraps(product)
    def guarded(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        try:
            return product(*arguments, **named)
        except torch.OutOfMemoryError as error:
            raise Unavailable(
                "device",
                expected="a GPU with free memory for the scene, the view's footprints and a band of its tiles",
                got=str(error).splitlines()[0],
                hint="free memory on the device, lower the images' resolution, or take the device cpu",
            ) from error

    return guarded


class GpuRaster:
    """A for one scene, of any kernel (``liftcore.raster.protocol.Raster``). Tensors come and go on the CPU.

    One call at a time: the view at hand is kept for the next product.

    Args:
        splats: the scene.
        device: a CUDA device; the CPU where Triton's interpreter is on.

    Raises:
        Unavailable: the device cannot run the kernels, or its memory does not hold the scene.
    """

    @_within_memory
    def __init__(self, splats: Splats, device: torch.device) -> None:
        check_device(device)
        self.splats = splats
        self.device = device
        scene = activated(splats, 1.0)
        self._scene = scene_on(device, scene)
        self._host = scene._replace(means=np.empty((0, 3), np.float32), axes=np.empty((0, 3, 3)))
        self._gain = 1.0  # of the scene
        self._kept: tuple[Camera, Walk, Frame] | None = None

    @_within_memory
    def region_weights(
        self, camera: Camera, observation: Observation, walk: Walk, weighting: Weighting
    ) -> RegionWeights:
        """``A'^T S`` of a view and the evidence of plain weights. See the protocol."""
        choice = choice_of(weighting)
        frame = self._frame(camera, walk)
        reading = DeviceReading(observation, camera, walk, self.device)
        return weighing.region_weights(frame, reading, choice, walk.gain != 1.0, self.splats.count)

    @_within_memory
    def render(self, camera: Camera, values: Tensor, walk: Walk) -> Tensor:
        """``A X``: values [P, C] f32 -> [H, W, C] f32. See the protocol."""
        check_rows(values, self.splats.count)
        frame = self._frame(camera, every_pixel(walk))
        image = torch.empty(camera.height, camera.width, values.shape[1])
        for begin in range(0, values.shape[1], rendering.WIDEST):
            block = values[:, begin : begin + rendering.WIDEST].to(self.device, torch.float32).contiguous()
            image[:, :, begin : begin + rendering.WIDEST] = rendering.render(frame, block).cpu()
        return image

    @_within_memory
    def adjoint(self, camera: Camera, values: Tensor, walk: Walk) -> Tensor:
        """``A^T Y``: values [H, W, C] f32 -> [P, C] f32. See the protocol."""
        check_image(values, camera)
        frame = self._frame(camera, every_pixel(walk))
        result = torch.empty(self.splats.count, values.shape[2])
        for begin in range(0, values.shape[2], weighing.WIDEST):
            block = values[:, :, begin : begin + weighing.WIDEST].to(self.device, torch.float32).contiguous()
            result[:, begin : begin + weighing.WIDEST] = weighing.adjoint(frame, block, self.splats.count).cpu()
        return result

    def row_sums(self, camera: Camera, walk: Walk) -> Tensor:
        """``A 1``: [H, W] f32."""
        return self.render(camera, torch.ones(self.splats.count, 1), walk)[:, :, 0]

    @_within_memory
    def top_weights(self, camera: Camera, walk: Walk, count: int) -> tuple[Tensor, Tensor]:
        """The largest weights of every ray, descending. See the protocol."""
        frame = self._frame(camera, every_pixel(walk))
        ids = torch.full((frame.rows * TILE, frame.columns * TILE, count), -1, dtype=torch.int32)
        weights = torch.zeros(frame.rows * TILE, frame.columns * TILE, count)
        for lists in frame.lists():
            for first, last in tile_runs(lists):
                own, numbers = largest_weights(frame, lists, (first, last), count)
                met = own > 0
                items = torch.where(met, lists.starts[first:last, None, None] + numbers, 0)
                named = torch.where(met, frame.ids[lists.items[items].long()] if lists.items.numel() else -1, -1)
                tile = torch.arange(lists.first_tile + first, lists.first_tile + last)[:, None]
                pixel = torch.arange(TILE * TILE)[None, :]
                y, x = tile // frame.columns * TILE + pixel // TILE, tile % frame.columns * TILE + pixel % TILE
                ids[y, x], weights[y, x] = named.to(torch.int32).cpu(), own.cpu()
        return ids[: camera.height, : camera.width].contiguous(), weights[
            : camera.height, : camera.width
        ].contiguous()

    @_within_memory
    def strongest_labels(self, camera: Camera, labels: Tensor, walk: Walk) -> Tensor:
        """``argmax(A onehot(labels))``: labels [P] i32 in -1..K - 1 -> [H, W] i32. See the protocol."""
        check_labels(labels, self.splats.count)
        frame = self._frame(camera, every_pixel(walk))
        return rendering.strongest_labels(frame, labels.to(self.device, torch.int32)).cpu()

    @_within_memory
    def ray_rows(self, camera: Camera, pixels: Tensor, walk: Walk) -> RayRows:
        """Rows of A for single pixels [n, 2] (x, y). See the protocol."""
        places = places_on(walk, pixels)
        if places is None:  # not all of them are rays of the strided view
            places, walk = pixels, every_pixel(walk)
        return ray_rows(self._frame(camera, walk), places.to(self.device, torch.int32).contiguous())

    def forget(self) -> None:
        """Drop the projected view that is kept for the next product."""
        self._kept = None

    def _frame(self, camera: Camera, walk: Walk) -> Frame:
        """The view projected; the last one is kept."""
        if self._kept is not None and self._kept[0] is camera and self._kept[1] == walk:
            return self._kept[2]
        check_antialiased(self.splats.kernel, walk.antialiased)
        check_stride(walk, camera)
        self._kept = None  # before, so that one frame's memory is the most ever held
        if walk.gain != self._gain:
            self._scene, self._gain = (
                with_opacity(self._scene, with_gain(self._host, self.splats, walk.gain)),
                walk.gain,
            )
        frame = Frame(self._scene, strided(view_of(camera), walk), self.splats.kernel, walk)
        self._kept = camera, walk, frame
        return frame
