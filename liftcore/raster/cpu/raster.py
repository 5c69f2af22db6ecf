"""The CPU backend: A by numba kernels, bitwise identical for any number of threads.

Work is split into a fixed number of shares that write to separate memory; threads only change which one computes
which share. The compiled kernels release the interpreter lock.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from itertools import chain, islice, pairwise
from queue import SimpleQueue
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.raster.base import Raster, RayRows, ViewRequest, ViewWeights, check_params
from liftcore.raster.cpu.composite import Frame, kernel_in, render_tiles, strongest_tiles, trace_rays
from liftcore.raster.cpu.project import (
    COLUMNS,
    EXTENT_X,
    EXTENT_Y,
    Targets,
    activate_splats,
    project,
    view_of,
    with_opacities,
)
from liftcore.raster.cpu.tiles import bin_tiles, depth_order
from liftcore.raster.cpu.weights import merge_entries, reading_of, weigh_tiles
from liftcore.runtime.cores import cores
from liftcore.runtime.device import give_back_memory
from liftcore.scene.compositing import TILE, CompositingParams, Weighting, check_weighting, every_pixel
from liftcore.values.region_weights import RegionWeights, one_view
from liftcore.values.views import DENSE_ROWS

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Sequence

    from torch import Tensor

    from liftcore.raster.cpu.project import Scene, View
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats
    from liftcore.values.views import ViewFeatures

SPLAT_SHARES = 8  # shares of projection and binning
TILE_SHARES = 48  # shares of compositing; more shares balance tiles with many splats
CHANNELS = 32  # per pass of the render, so that a tile's sums stay in the cache
VIEWS = 4  # processed at a time, at most: each has its own projected splats and tile lists


class CpuRaster:
    """A for one scene, of any kernel (``liftcore.raster.base.Raster``).

    One call at a time: the next view overwrites the buffers of projected splats. ``iterate_views`` processes several
    views at a time with copies of this raster, each with its own buffers.

    Args:
        splats: the scene.
    """

    def __init__(self, splats: Splats, threads: int | None = None) -> None:
        self.splats = splats
        self._scene = activate_splats(splats, 1.0)
        self._scale = 1.0  # of the scene's opacity logits
        self._allocate(threads or cores())

    def _allocate(self, threads: int) -> None:
        """Allocate the thread pool and the buffers of projected splats."""
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads)
        self._projected = np.empty((self.splats.count, COLUMNS[self.splats.kernel]))
        self._depths = np.empty(self.splats.count, np.float32)
        self._last_view: tuple[tuple[Camera, CompositingParams], Frame] | None = None

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, params: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """Return ``A'^T S`` of a view and the total weight of unscaled weights. See the protocol."""
        check_weighting(weighting)
        frame = self._frame(camera, params)
        reading = reading_of(observation, camera.width, camera.height, params)
        with_unscaled = True if params.opacity_logit_scale != 1.0 else None

        def weigh_share(first: int, last: int) -> tuple[np.ndarray, ...]:
            return weigh_tiles(first, last, frame, reading, weighting.power == 2, weighting.top_k, with_unscaled)

        entries = self._over_tiles(frame, weigh_share)
        rows = merge_entries(entries, frame.ids, reading.codebook_rows, self.threads, self._map)
        return one_view(*map(torch.from_numpy, rows), regions=reading.codebook_rows)

    def iterate_views(self, requests: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """Yield ``region_weights`` and ``ray_rows`` of views, ``views_at_a_time`` in parallel.

        Dense maps are processed one after the other, as the weights of one take gigabytes.
        """
        requests = iter(requests)
        first = list(islice(requests, views_at_a_time(self.threads)))  # with fewer views, each has more threads
        if not first:
            return
        self._scene_with(first[0].params.opacity_logit_scale)  # once: all views of a lift have the same scale
        raster_count = 1 if any(map(_is_dense, first)) else len(first)
        rasters = [self._copy_with_threads(end - begin) for begin, end in _shares(self.threads, raster_count)]
        try:
            yield from side_by_side(rasters, chain(first, requests))
        finally:
            rasters.clear()
            give_back_memory()

    def _copy_with_threads(self, threads: int) -> CpuRaster:
        """Return another raster of the same scene, with its own threads and buffers."""
        other = copy.copy(self)
        other._allocate(threads)
        return other

    def render(self, camera: Camera, values: Tensor, params: CompositingParams) -> Tensor:
        """Return ``A X``: values [P, C] f32 -> [H, W, C] f32. See the protocol."""
        frame, channels = self._frame(camera, every_pixel(params)), values.shape[1]
        image = np.zeros((camera.height, camera.width, channels), np.float32)
        for begin in range(0, channels, CHANNELS):
            block = np.ascontiguousarray(values[:, begin : begin + CHANNELS].to(torch.float32).numpy())
            is_one_pass = block.shape[1] == channels
            target = image if is_one_pass else np.zeros((camera.height, camera.width, block.shape[1]), np.float32)
            self._over_tiles(frame, partial(render_tiles, frame=frame, values=block, image=target))
            if not is_one_pass:
                image[:, :, begin : begin + CHANNELS] = target
        return torch.from_numpy(image)

    def row_sums(self, camera: Camera, params: CompositingParams) -> Tensor:
        """Return ``A 1``: [H, W] f32."""
        return self.render(camera, torch.ones(self.splats.count, 1, dtype=torch.float32), params)[:, :, 0]

    def strongest_labels(self, camera: Camera, labels: Tensor, params: CompositingParams) -> Tensor:
        """Return ``argmax(A onehot(labels))``: labels [P] i32 in -1..K - 1 -> [H, W] i32. See the protocol."""
        flat, count = np.ascontiguousarray(labels.to(torch.int32).numpy()), int(labels.max()) + 1
        image, frame = np.full((camera.height, camera.width), -1, np.int32), self._frame(camera, every_pixel(params))
        self._over_tiles(frame, partial(strongest_tiles, frame=frame, labels=flat, count=count, image=image))
        return torch.from_numpy(image)

    def ray_rows(self, camera: Camera, pixels: Tensor, params: CompositingParams) -> RayRows:
        """Return rows of A for single pixels [n, 2] (x, y). See the protocol."""
        if not len(pixels):
            return RayRows(
                torch.zeros(1, dtype=torch.int64), pixels.new_empty(0), torch.empty(0, dtype=torch.float32)
            )
        rays = (pixels.to(torch.int32).numpy() - np.array(params.offset, np.int32)) // params.stride
        return RayRows(*map(torch.from_numpy, trace_rays(self._frame(camera, params), np.ascontiguousarray(rays))))

    def footprints(self, camera: Camera, params: CompositingParams) -> Tensor:
        """Return the areas [P] f32 of the splats' outlines. See the protocol."""
        check_params(self.splats.kernel, camera, params)
        self.forget()  # the projection below overwrites its splats
        ids, rows = self._project(view_of(camera, every_pixel(params), self.splats.origin), params)
        outlines = math.pi * self._projected[rows, EXTENT_X] * self._projected[rows, EXTENT_Y]
        areas = np.zeros(self.splats.count, np.float32)
        areas[ids[rows]] = outlines.clip(np.finfo(np.float32).tiny, camera.width * camera.height)
        return torch.from_numpy(areas)

    def forget(self) -> None:
        """Drop the cached projection of the last view."""
        self._last_view = None

    def _frame(self, camera: Camera, params: CompositingParams) -> Frame:
        """Project and bin the view; the last view is cached."""
        key = (camera, params)
        if self._last_view is None or self._last_view[0] != key:
            check_params(self.splats.kernel, camera, params)
            self.forget()  # first, so that at most one view is in memory
            view = view_of(camera, params, self.splats.origin)
            self._last_view = key, self._bin(view, params, *self._project(view, params))
        return self._last_view[1]

    def _project(self, view: View, params: CompositingParams) -> tuple[np.ndarray, np.ndarray]:
        """Fill the projected splats; return the splat of each row [P] i32 and the depth order [n] i32."""
        targets = Targets(self._projected, self._depths, np.full(self.splats.count, -1, np.int32))
        scene, kernel = self._scene_with(params.opacity_logit_scale), self.splats.kernel
        bounds = _shares(self.splats.count, SPLAT_SHARES)
        counts = self._map(
            lambda first, last: project((first, last), scene, view, kernel, params.antialiased, targets), bounds
        )
        rows_by_share = [
            np.arange(first, first + count, dtype=np.int32) for (first, _), count in zip(bounds, counts, strict=True)
        ]
        rows = np.concatenate(rows_by_share) if rows_by_share else np.empty(0, np.int32)
        return targets.ids, depth_order(self._depths[rows].view(np.uint32), rows)

    def _bin(self, view: View, params: CompositingParams, ids: np.ndarray, order: np.ndarray) -> Frame:
        columns, rows = -(-view.width // TILE), -(-view.height // TILE)
        no_lists = np.zeros(rows * columns + 1, np.int64), np.empty(0, np.int32)
        frame = Frame(
            kernel_in(view, self.splats.kernel), self._projected, ids, *no_lists,
            columns, rows, view.width, view.height, params.alpha_cap, params.transmittance_stop,
        )  # fmt: skip
        parts = [order[first:last] for first, last in _shares(order.shape[0], SPLAT_SHARES)]
        return bin_tiles(frame, parts, self._map)

    def _scene_with(self, scale: float) -> Scene:
        if scale != self._scale:
            self._scene, self._scale = with_opacities(self._scene, self.splats, scale), scale
        return self._scene

    def _over_tiles(self, frame: Frame, work: Callable) -> list:
        """Run ``work(first, last)`` over shares of a frame's tiles with about as many list items each."""
        tiles = frame.columns * frame.rows
        marks = np.linspace(0, frame.starts[-1], TILE_SHARES + 1)
        edges = np.unique(np.concatenate([[0], np.searchsorted(frame.starts, marks[1:-1]), [tiles]]))
        return self._map(work, [(int(a), int(b)) for a, b in pairwise(edges)])

    def _map(self, work: Callable, shares: list) -> list:
        if self.threads == 1:
            return [work(*share) for share in shares]
        return list(self._pool.map(lambda share: work(*share), shares))


def _shares(total: int, count: int) -> list[tuple[int, int]]:
    """Return ``count`` ranges that cover ``total`` items."""
    edges = [total * k // count for k in range(count + 1)]
    return list(pairwise(edges))


# Several views at a time: with a view per core no core waits for the last share of a stage, and the single-threaded
# steps of one view overlap with the work of another. On two cores this saves a fifth of the time.


def views_at_a_time(threads: int) -> int:
    """Return the number of views that this many threads process in parallel."""
    return min(threads, VIEWS)


def one_by_one(raster: Raster, requests: Iterable[ViewRequest]) -> Generator[ViewWeights]:
    """Yield the results of ``Raster.iterate_views``, one view at a time."""
    try:
        for request in requests:
            yield _weights_of(raster, request)
    finally:
        raster.forget()


def side_by_side(rasters: Sequence[Raster], requests: Iterable[ViewRequest]) -> Generator[ViewWeights]:
    """Yield the results of ``Raster.iterate_views`` with one view at a time on each of the rasters of the scene.

    The next request and its view are read while others are processed. Results come in the order of the requests and
    do not depend on the raster. Closing the iterator waits for the views in progress. At most one dense map is
    processed at a time, in parallel with other views.
    """
    if len(rasters) == 1:
        yield from one_by_one(rasters[0], requests)
        return
    free, lock = SimpleQueue[Raster](), Lock()
    for raster in rasters:
        free.put(raster)

    def work(request: ViewRequest) -> ViewWeights:
        raster = free.get()
        try:
            with lock if _is_dense(request) else nullcontext():
                return _weights_of(raster, request)
        finally:
            free.put(raster)

    pool = ThreadPoolExecutor(len(rasters))
    try:
        waiting = deque()
        for request in requests:
            waiting.append(pool.submit(work, request))
            if len(waiting) > len(rasters):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        for raster in rasters:
            raster.forget()


def _is_dense(request: ViewRequest) -> bool:
    return len(request.observation.codebook) > DENSE_ROWS


def _weights_of(raster: Raster, request: ViewRequest) -> ViewWeights:
    """Return the region weights of one view, and the rows of A of its requested rays."""
    camera, params = request.camera, request.params
    weights = raster.region_weights(camera, request.observation, params, request.weighting)
    return ViewWeights(weights, raster.ray_rows(camera, request.pixels, params))
