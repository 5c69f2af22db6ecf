"""The CPU backend: A on two cores or on sixty, the same to the bit.

Work is cut into a fixed number of shares, each with places of its own to write to; threads only decide who does
which share. The compiled kernels release the interpreter lock.
"""

from __future__ import annotations

import copy
import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import chain, islice, pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.heap import give_back_free_memory
from liftcore.raster.antialiased import check_antialiased
from liftcore.raster.base import CompositingParams, RayRows, RegionWeights, ViewRequest, ViewWeights, Weighting
from liftcore.raster.constants import TILE
from liftcore.raster.cpu.adjoint import add_sums, gather_tiles
from liftcore.raster.cpu.arguments import check_image, check_labels, check_rows
from liftcore.raster.cpu.bands import Bands, entries_of, in_order, no_lists
from liftcore.raster.cpu.depth_order import depth_order
from liftcore.raster.cpu.kernels import RECORDS, activated, kernel_in, project, with_gain
from liftcore.raster.cpu.merging import count_entries, gather_entries, merge_range
from liftcore.raster.cpu.projection import Targets, view_of
from liftcore.raster.cpu.readings import reading_of
from liftcore.raster.cpu.region_weights import weigh_tiles
from liftcore.raster.cpu.rendering import render_tiles, trace_rays
from liftcore.raster.cpu.selection import choice_of
from liftcore.raster.cpu.side_by_side import side_by_side, views_at_a_time
from liftcore.raster.cpu.strided import check_stride, every_pixel, places_on, strided
from liftcore.raster.cpu.strongest import strongest_tiles
from liftcore.raster.cpu.walk import Frame

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable

    from torch import Tensor

    from liftcore.features.views import ViewFeatures
    from liftcore.raster.cpu.projection import Scene, View
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

SPLAT_SHARES = 8  # shares of the projection and the binning
TILE_SHARES = 48  # shares of the blending; more of them even out crowded tiles
RENDER_CHANNELS = 32  # channels a pass of the render, so that a tile's sums stay in the cache


class CpuRaster:
    """A for one scene, of any kernel (``liftcore.raster.base.Raster``).

    One call at a time: the footprints of the view at hand live in buffers that the next view overwrites.
    ``iterate_views`` works on several views at a time with rasters like this one, each with buffers of its own.

    Args:
        splats: the scene.
        threads: how many threads work; None takes the cores that this process may use. The number changes no bit.
    """

    def __init__(self, splats: Splats, threads: int | None = None) -> None:
        self.splats = splats
        self._scene = activated(splats, 1.0)
        self._gain = 1.0  # of the scene
        self._make_room(threads or len(os.sched_getaffinity(0)))

    def _make_room(self, threads: int) -> None:
        """Threads and buffers of its own."""
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads)
        self._records = np.empty((self.splats.count, RECORDS[self.splats.kernel]))
        self._depths = np.empty(self.splats.count, np.float32)
        self._kept: tuple[tuple[Camera, CompositingParams], Bands] | None = None

    def region_weights(
        self, camera: Camera, observation: ViewFeatures, walk: CompositingParams, weighting: Weighting
    ) -> RegionWeights:
        """``A'^T S`` of a view and the evidence of plain weights. See the protocol."""
        choice = choice_of(weighting)
        bands = self._bands(camera, walk)
        reading = reading_of(observation, camera.width, camera.height, walk)
        squared, gate = choice.power == 2, choice if choice.gated else None
        plain = True if walk.opacity_logit_scale != 1.0 else None

        def weigh(frame: Frame, first: int, last: int) -> tuple[np.ndarray, ...]:
            return weigh_tiles(first, last, frame, reading, squared, gate, plain)

        frames = iter(bands)
        frame = next(frames)
        found = self._merge(frame, self._over_tiles(frame, weigh), reading.codebook_rows)
        for frame in frames:
            before = entries_of(found, frame.ids, reading.codebook_rows, reading.levels)
            found = self._merge(frame, [before, *self._over_tiles(frame, weigh)], reading.codebook_rows)
        return found

    def iterate_views(self, looks: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """``region_weights`` and ``ray_rows`` of views, ``views_at_a_time`` side by side."""
        looks = iter(looks)
        first = list(islice(looks, views_at_a_time(self.threads)))  # fewer views than that have more threads each
        if not first:
            return
        self._activated(first[0].params.opacity_logit_scale)  # once for all: the views of a lift have one gain
        rasters = [self._beside(end - begin) for begin, end in _shares(self.threads, len(first))]
        try:
            yield from side_by_side(rasters, chain(first, looks))
        finally:
            rasters.clear()
            give_back_free_memory()

    def _beside(self, threads: int) -> CpuRaster:
        """Another raster of the same scene, which may work at the same time."""
        other = copy.copy(self)
        other._make_room(threads)
        return other

    def render(self, camera: Camera, values: Tensor, walk: CompositingParams) -> Tensor:
        """``A X``: values [P, C] f32 -> [H, W, C] f32. See the protocol."""
        check_rows(values, self.splats.count)
        bands, channels = self._bands(camera, every_pixel(walk)), values.shape[1]
        image = np.zeros((camera.height, camera.width, channels), np.float32)
        for begin in range(0, channels, RENDER_CHANNELS):
            end = min(begin + RENDER_CHANNELS, channels)
            block = np.ascontiguousarray(values[:, begin:end].to(torch.float32).numpy())
            alone = end - begin == channels
            target = image if alone else np.zeros((camera.height, camera.width, end - begin), np.float32)
            for frame in bands:
                self._over_tiles(frame, partial(_render, block, target))
            if not alone:
                image[:, :, begin:end] = target
        return torch.from_numpy(image)

    def adjoint(self, camera: Camera, values: Tensor, walk: CompositingParams) -> Tensor:
        """``A^T Y``: values [H, W, C] f32 -> [P, C] f32, the transpose of the render. See the protocol."""
        check_image(values, camera)
        bands, channels = self._bands(camera, every_pixel(walk)), values.shape[2]
        result = np.zeros((self.splats.count, channels), np.float32)
        for begin in range(0, channels, RENDER_CHANNELS):
            image = values[:, :, begin : begin + RENDER_CHANNELS].to(torch.float32).numpy()
            for frame in bands:
                self._add_adjoint(frame, np.ascontiguousarray(image), result, begin)
        return torch.from_numpy(result)

    def _add_adjoint(self, frame: Frame, image: np.ndarray, result: np.ndarray, begin: int) -> None:
        """Add what the frame's tiles give back of a few channels of the image to ``result``, from ``begin`` on."""
        shares = self._over_tiles(frame, lambda frame, first, last: gather_tiles(first, last, frame, image))

        def merge(first: int, last: int) -> None:
            for share in shares:
                add_sums(first, last, share, frame.ids, result, begin)

        # Each record is in one range and its shares come in order, so the number of ranges changes no sum.
        self._map(merge, _shares(self.splats.count, self.threads))

    def row_sums(self, camera: Camera, walk: CompositingParams) -> Tensor:
        """``A 1``: [H, W] f32."""
        return self.render(camera, torch.ones(self.splats.count, 1), walk)[:, :, 0]

    def strongest_labels(self, camera: Camera, labels: Tensor, walk: CompositingParams) -> Tensor:
        """``argmax(A onehot(labels))``: labels [P] i32 in -1..K - 1 -> [H, W] i32. See the protocol."""
        check_labels(labels, self.splats.count)
        flat, count = np.ascontiguousarray(labels.to(torch.int32).numpy()), int(labels.max()) + 1
        image = np.full((camera.height, camera.width), -1, np.int32)
        for frame in self._bands(camera, every_pixel(walk)):
            self._over_tiles(
                frame, lambda frame, first, last: strongest_tiles(first, last, frame, flat, count, image)
            )
        return torch.from_numpy(image)

    def ray_rows(self, camera: Camera, pixels: Tensor, walk: CompositingParams) -> RayRows:
        """Rows of A for single pixels [n, 2] (x, y). See the protocol."""
        places = places_on(walk, pixels)
        if places is None:  # not all of them are rays of the strided view
            places, walk = pixels, every_pixel(walk)
        rays = np.ascontiguousarray(places.to(torch.int32).numpy())
        rows = in_order([trace_rays(frame, rays) for frame in self._bands(camera, walk)])
        return RayRows(*map(torch.from_numpy, rows))

    def forget(self) -> None:
        """Drop the projected view that is kept for the next product."""
        self._kept = None

    def _bands(self, camera: Camera, walk: CompositingParams) -> Bands:
        """The view projected and binned; the last one is kept."""
        key = (camera, walk)
        if self._kept is None or self._kept[0] != key:
            check_antialiased(self.splats.kernel, walk.antialiased)
            check_stride(walk, camera)
            self.forget()  # before the next, so that one view's memory is the most ever held
            view = strided(view_of(camera), walk)
            self._kept = key, self._bin(view, walk, *self._project(view, walk))
        return self._kept[1]

    def _project(self, view: View, walk: CompositingParams) -> tuple[np.ndarray, np.ndarray]:
        """Fill the records; give the splat of every record [P] i32 and the depth order [n] i32."""
        targets = Targets(self._records, self._depths, np.full(self.splats.count, -1, np.int32))
        scene, kernel = self._activated(walk.opacity_logit_scale), self.splats.kernel
        bounds = _shares(self.splats.count, SPLAT_SHARES)
        counts = self._map(
            lambda first, last: project((first, last), scene, view, kernel, walk.antialiased, targets), bounds
        )
        used = [
            np.arange(first, first + count, dtype=np.int32) for (first, _), count in zip(bounds, counts, strict=True)
        ]
        places = np.concatenate(used) if used else np.empty(0, np.int32)
        return targets.ids, depth_order(self._depths[places].view(np.uint32), places)

    def _bin(self, view: View, walk: CompositingParams, ids: np.ndarray, order: np.ndarray) -> Bands:
        columns, rows = -(-view.width // TILE), -(-view.height // TILE)
        frame = Frame(
            kernel_in(view, self.splats.kernel), self._records, ids, *no_lists(rows * columns),
            columns, rows, view.width, view.height, walk.alpha_cap, walk.transmittance_stop,
        )  # fmt: skip
        parts = [order[first:last] for first, last in _shares(order.shape[0], SPLAT_SHARES)]
        return Bands(frame, parts, self._map)

    def _merge(self, frame: Frame, entries: list, codebook_rows: int) -> RegionWeights:
        """Entries of all tile shares -> one row a splat."""
        slot_rows = np.concatenate([share[4] for share in entries])
        bases = np.cumsum([0, *(share[4].shape[0] for share in entries)])

        ends = self._entry_ends(entries)

        def merge(first: int, last: int) -> tuple[np.ndarray, ...]:
            before = ends[first - 1] if first else 0
            starts = np.concatenate([[before], ends[first:last]]) - before
            words, totals = np.empty((starts[-1], 2), np.int32), np.zeros(last - first)
            gathered, cursors = (words, words.view(np.float32), totals), starts[:-1].copy()
            for share, base in zip(entries, bases[:-1], strict=True):
                gather_entries(first, last, share[:4], base, cursors, gathered)
            return merge_range(starts, gathered, slot_rows, codebook_rows, frame.ids[first:last])

        # A range's rows depend on its own entries only, so their number may follow the threads: fewer reads of all.
        marks = np.searchsorted(ends, np.linspace(0, ends[-1], self.threads + 1)[1:-1], side="right")
        edges = [0, *marks.tolist(), self.splats.count]
        parts = self._map(merge, list(pairwise(edges)))
        splats, lengths, columns, weights, met, evidence = (np.concatenate(part) for part in zip(*parts, strict=True))
        indptr = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        return RegionWeights(*(torch.from_numpy(part) for part in (splats, indptr, columns, weights, met, evidence)))

    def _entry_ends(self, entries: list) -> np.ndarray:
        """[P] i64: how many entries the records up to each one have."""

        def count(first: int, last: int) -> np.ndarray:
            counts = np.zeros(self.splats.count, np.int32)
            for share in entries[first:last]:
                count_entries(share[0], counts)
            return counts

        counts = self._map(count, _shares(len(entries), self.threads))
        return np.cumsum(np.sum(counts, axis=0, dtype=np.int64))

    def _activated(self, gain: float) -> Scene:
        if gain != self._gain:
            self._scene, self._gain = with_gain(self._scene, self.splats, gain), gain
        return self._scene

    def _over_tiles(self, frame: Frame, work: Callable) -> list:
        """Run ``work(frame, first, last)`` over tile shares of about equal length in list items."""
        tiles = frame.columns * frame.rows
        marks = np.linspace(0, frame.starts[-1], TILE_SHARES + 1)
        edges = np.unique(np.concatenate([[0], np.searchsorted(frame.starts, marks[1:-1]), [tiles]]))
        return self._map(work, [(frame, int(a), int(b)) for a, b in pairwise(edges)])

    def _map(self, work: Callable, shares: list) -> list:
        if self.threads == 1:
            return [work(*share) for share in shares]
        return list(self._pool.map(lambda share: work(*share), shares))


def _render(values: np.ndarray, image: np.ndarray, frame: Frame, first: int, last: int) -> None:
    render_tiles(first, last, frame, values, image)


def _shares(total: int, count: int) -> list[tuple[int, int]]:
    """``count`` ranges that cover ``total`` items."""
    edges = [total * k // count for k in range(count + 1)]
    return list(pairwise(edges))
