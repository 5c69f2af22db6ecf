"""What peers' CUDA code does, compiled for the CPU: every weight times all channels of its pixel, added to its splat.

Projection, depth order and tile lists are splatlift's own, and so are the bounds of a splat's pixels: what differs is
the accumulation alone, and this peer starts with a geometry that is faster than it would bring. Where a GPU adds
atomically, each thread here has sums of its own, which are added up at the end.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import torch
from numba import njit

from liftcore.raster.constants import ALPHA_FLOOR, TILE
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.cpu.records import KY, MX, MY, OPACITY, REACH, ROOT_X, SLOPE
from tests.benchmarks.peers.work import Answer, Work, answer_of, dense_target

if TYPE_CHECKING:
    from liftcore.raster.base import CompositingParams
    from liftcore.raster.cpu.walk import Frame
    from liftcore.scene.cameras import Camera

SHARES = 32  # of the tiles, dealt out to the threads in turn
CHECK_EVERY = 16  # splats between two looks at whether a tile still has light


class DenseNumba:
    """See ``tests.benchmarks.peers.peer.Peer``."""

    name = "dense numba"
    computes = "for each weight `w` of a pixel, `w b` of all channels onto the splat's own (compiled, both cores)"

    def missing(self) -> str:
        """Nothing."""
        return ""

    def lift(self, work: Work) -> Answer:
        """Tile by tile, splat by splat, pixel by pixel, channel by channel."""
        lists = _Lists(work.splats, work.threads)
        own = np.zeros((work.threads, work.splats.count, work.channels + 1), np.float32)
        with ThreadPoolExecutor(work.threads) as pool:
            for camera, regions in work.views:
                frame = lists.frame(camera, work.walk)
                target = dense_target(camera, regions).numpy()
                threads, edges = work.threads, _tile_shares(frame)
                parts = [pool.submit(_add_shares, k, threads, edges, frame, target, own[k]) for k in range(threads)]
                for part in parts:
                    part.result()
        return answer_of(torch.from_numpy(own.sum(axis=0)))


class _Lists(CpuRaster):
    """splatlift's geometry without its walk."""

    def frame(self, camera: Camera, walk: CompositingParams) -> Frame:
        """The view projected, ordered and binned."""
        (frame,) = self._bands(camera, walk)
        return frame


def _tile_shares(frame: Frame) -> np.ndarray:
    """Edges of runs of tiles with about as many list items each."""
    marks = np.linspace(0, frame.starts[-1], SHARES + 1)
    return np.searchsorted(frame.starts, marks).clip(0, frame.columns * frame.rows)


@njit(nogil=True, cache=True)
def _add_shares(thread, threads, edges, frame, target, sums):
    """``A^T [B n]`` of every ``threads``-th share of the tiles, from share ``thread`` on.

    Args:
        edges: [SHARES + 1] i64. frame: Frame. target: [H, W, F + 1] f32. sums: [P, F + 1] f32, grows.
    """
    light = np.empty((TILE, TILE), np.float32)
    for share in range(thread, edges.shape[0] - 1, threads):
        for tile in range(edges[share], edges[share + 1]):
            x0, y0 = tile % frame.columns * TILE, tile // frame.columns * TILE
            width, height = min(TILE, frame.width - x0), min(TILE, frame.height - y0)
            light[:] = 0
            light[:height, :width] = 1
            for step in range(frame.starts[tile], frame.starts[tile + 1]):
                if (step - frame.starts[tile]) % CHECK_EVERY == 0 and light.max() <= 0:
                    break
                place = frame.items[step]
                box = x0, y0, width, height
                _add_splat(frame, frame.records[place], box, light, target, sums[frame.ids[place]])


@njit(nogil=True, cache=True)
def _add_splat(frame, record, box, light, target, row):
    """One splat's weights on one tile, times the pixels, onto its row of sums [F + 1]; light ends at 0.

    box: x, y, width, height of the tile, px. target: [H, W, F + 1] f32, read whole pixels at a time.
    """
    x0, y0, width, height = box
    opacity, kx, cap = np.float32(record[OPACITY]), np.float32(record[ROOT_X] ** 2), np.float32(frame.cap)
    for y in range(height):
        dy = y0 + y + 0.5 - record[MY]
        base = record[KY] * dy * dy
        if base > record[REACH]:
            continue
        centre = record[MX] + record[SLOPE] * dy - x0 - 0.5
        half = math.sqrt(record[REACH] - base) / record[ROOT_X]
        for x in range(max(0, math.ceil(centre - half)), min(width - 1, math.floor(centre + half)) + 1):
            before = light[y, x]
            if before <= 0:
                continue
            dx = np.float32(x - centre)
            alpha = opacity * np.exp2(-(kx * dx * dx + np.float32(base)))
            if alpha < np.float32(ALPHA_FLOOR):
                continue
            alpha = min(alpha, cap)
            after = before * (np.float32(1) - alpha)
            if after <= np.float32(frame.stop):
                light[y, x] = 0
                continue
            light[y, x] = after
            _add_scaled(row, alpha * before, target[y0 + y, x0 + x])


@njit(nogil=True, cache=True, fastmath={"contract"})
def _add_scaled(row, weight, pixel):
    """``row += weight pixel``, all channels: the inner loop, eight channels an instruction."""
    for channel in range(row.shape[0]):
        row[channel] += weight * pixel[channel]
