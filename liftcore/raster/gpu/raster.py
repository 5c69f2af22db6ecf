"""The GPU backend: region weights by Triton kernels, bitwise identical in every run.

The CPU projects, in a thread beside the GPU's work on the view before. Tile lists are tensor operations on the
device, except for the tile columns of a splat, which a kernel computes (``tiles``). One program per tile composites
its rays (``composite``), and the product loads the weights as a matrix (``weights``). Sums over tiles are float64 in
a fixed order. No two programs add to the same memory. All other products, and the largest weights of a ray, are the
CPU's. On CPU tensors the kernels run in Triton's interpreter, for tests without a GPU.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from contextvars import copy_context
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import torch

from liftcore.raster.base import RayRows, ViewRequest, ViewWeights, check_params
from liftcore.raster.cpu.project import View, view_of
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.gpu.launching import check_device
from liftcore.raster.gpu.tiles import Frame, frame_of
from liftcore.raster.gpu.weights import DeviceReading, region_weights
from liftcore.scene.compositing import CompositingParams, Weighting, check_weighting
from liftcore.values.views import NO_LABEL, Regions

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable

    from torch import Tensor

    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats
    from liftcore.values.region_weights import RegionWeights
    from liftcore.values.views import ViewFeatures

Item = TypeVar("Item")
Output = TypeVar("Output")


class Projection(NamedTuple):
    """The projected splats of a view, near to far, on the host."""

    view: View
    ids: Tensor  # [n] i32
    splats: Tensor  # [n, COLUMNS] f64


class GpuRaster(CpuRaster):
    """A for one scene, of any kernel (``liftcore.raster.base.Raster``). Arguments and results are CPU tensors.

    One call at a time: the last view is cached for its rows of single rays.

    Args:
        device: a CUDA device; the CPU if Triton's interpreter is on.

    Raises:
        Unavailable: the device cannot run the kernels.
    """

    def __init__(self, splats: Splats, device: torch.device, threads: int | None = None) -> None:
        check_device(device)
        super().__init__(splats, threads)
        self.device = torch.empty(0, device=device).device  # with an index, as tensors have it
        self._last_frame: tuple[tuple[Camera, CompositingParams], Frame] | None = None

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """Return ``A'^T S`` of a view and the total weight of unscaled weights. See the protocol."""
        check_weighting(weighting)
        if weighting.top_k:
            return super().region_weights(camera, observation, params, weighting)
        projection = self._projection(camera, params)
        reading = DeviceReading(observation, camera, params, self.device)
        return self._weigh(projection, reading, camera, params, weighting)

    def iterate_views(self, requests: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """Yield ``region_weights`` and ``ray_rows`` of views, one at a time; the next is read while the GPU works."""

        def read(request: ViewRequest) -> tuple[Projection, DeviceReading] | None:
            camera, params = request.camera, request.params
            if request.weighting.top_k:
                return None
            projection = self._projection(camera, params)
            return projection, DeviceReading(request.observation, camera, params, self.device)

        try:
            with closing(prefetch(requests, read)) as views:
                for request, inputs in views:
                    camera, params = request.camera, request.params
                    yield ViewWeights(  # not bound to a name, which would keep it in memory with the next one
                        self._weigh(*inputs, camera, params, request.weighting)
                        if inputs
                        else self.region_weights(camera, request.observation, params, request.weighting),
                        self.ray_rows(camera, request.pixels, params),
                    )
        finally:
            self.forget()

    def ray_rows(self, camera: Camera, pixels: Tensor, params: CompositingParams) -> RayRows:
        """Return rows of A for single pixels [n, 2] (x, y), splats in ascending order. See the protocol."""
        places, rays = np.unique(pixels.numpy(), axis=0, return_inverse=True)
        if not len(places):
            return super().ray_rows(camera, pixels, params)
        labels = np.full((1, camera.height, camera.width), NO_LABEL, np.int32)
        labels[0, places[:, 1], places[:, 0]] = np.arange(len(places))  # a region a ray: its weights are a row of A
        regions = Regions.unchecked(torch.from_numpy(labels), torch.empty(len(places), 0))
        reading = DeviceReading(regions, camera, params, self.device)
        frame = self._frame_on_device(camera, params)
        W = region_weights(frame, reading, squared=False, with_unscaled=False, labelled_tiles=True)
        A = W.cpu().matrix(self.splats.count).T.tocsr()[rays]
        return RayRows(*(torch.from_numpy(part) for part in (A.indptr.astype(np.int64), A.indices, A.data)))

    def forget(self) -> None:
        """Drop the cached projection of the last view."""
        super().forget()
        self._last_frame = None

    def _weigh(
        self,
        projection: Projection,
        reading: DeviceReading,
        camera: Camera,
        params: CompositingParams,
        weighting: Weighting,
    ) -> RegionWeights:
        frame = self._frame_on_device(camera, params, projection)
        with_unscaled = params.opacity_logit_scale != 1.0
        return region_weights(frame, reading, weighting.power == 2, with_unscaled).cpu()

    def _projection(self, camera: Camera, params: CompositingParams) -> Projection:
        check_params(self.splats.kernel, camera, params)
        view = view_of(camera, params, self.splats.origin)
        ids, order = (torch.from_numpy(part) for part in self._project(view, params))
        return Projection(view, ids[order], torch.from_numpy(self._projected)[order])  # a copy

    def _frame_on_device(
        self, camera: Camera, params: CompositingParams, projection: Projection | None = None
    ) -> Frame:
        """Return the view on the device; the last view is cached."""
        if self._last_frame is None or self._last_frame[0] != (camera, params):
            self._last_frame = None  # first, so that at most one view is in memory
            view, ids, splats = projection or self._projection(camera, params)
            ids, splats = ids.to(self.device), splats.to(self.device)
            self._last_frame = (camera, params), frame_of(ids, splats, view, self.splats.kernel, params)
        return self._last_frame[1]


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
