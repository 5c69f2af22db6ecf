"""The lift as a gradient: ``d/dx sum(render(x) B) = A^T B`` by autograd, with a renderer of plain torch operations.

The renderer is written to be fast on a CPU: tight tile lists, depth slabs of many tiles at a time, alphas composited
by a cumulative product along depth, tiles without light left out of the next slab. Weights do not depend on x and are
made once for all channels, which go in chunks, so that memory is bounded by the slab. Each thread has tiles and sums
of its own, and torch one thread in each: its own threads wait for one another at every operation.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch.nn.functional import embedding, normalize, pad, threshold

from liftcore.raster.constants import ALPHA_FLOOR, FIELD_MARGIN, LOW_PASS, NEAR_PLANE
from tests.benchmarks.peers.work import Answer, Work, answer_of, dense_target, torch_threads

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

    from liftcore.raster.base import CompositingParams
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

TILE = 8  # pixels; 16 takes a quarter longer
SLAB = 128  # splats along the depth of a tile at a time
WEIGHTS = 1 << 20  # of a batch of slabs: 4 MiB an intermediate
CHANNELS = 128  # a chunk


class TorchAutograd:
    """See ``tests.benchmarks.peers.peer.Peer``."""

    name = "torch autograd"
    computes = "`d/dx sum(render(x) B)` with a tiled renderer of torch operations (cumulative products, both cores)"

    def missing(self) -> str:
        """Nothing."""
        return ""

    def lift(self, work: Work) -> Answer:
        """View by view, slab by slab, chunk by chunk of channels."""
        own = torch.zeros(work.threads, work.splats.count, work.channels + 1)
        with (
            torch_threads(1),
            ThreadPoolExecutor(work.threads, initializer=torch.set_num_threads, initargs=(1,)) as pool,
        ):
            for camera, regions in work.views:
                footprints = _project(work.splats, camera)
                lists, target = _lists(footprints, camera), by_tile(dense_target(camera, regions))
                view = _View(camera, work.walk, footprints, lists, target)
                tiles = torch.arange(len(target))
                parts = [pool.submit(_add_view, view, tiles[k :: work.threads], sums) for k, sums in enumerate(own)]
                for part in parts:
                    part.result()
        return answer_of(own.sum(dim=0))


class _Footprints(NamedTuple):
    """The splats that a view may see, near to far; n of them."""

    splats: Tensor  # [n] i64
    mean: Tensor  # [n, 2] f32, px
    conic: Tensor  # [n, 3] f32: xx, xy, yy of the inverse covariance
    opacity: Tensor  # [n] f32
    extent: Tensor  # [n, 2] f32, px from the mean to where alpha falls below its floor


class _View(NamedTuple):
    """A view to lift from."""

    camera: Camera
    walk: CompositingParams
    footprints: _Footprints
    lists: tuple[Tensor, Tensor]  # starts [tiles + 1] and items of every tile's list of footprints, near to far
    target: Tensor  # [tiles, TILE * TILE, F + 1] f32


class _Slab(NamedTuple):
    """Weights of some splats on some tiles."""

    tiles: Tensor  # [t] i64
    splats: Tensor  # [t, k] i64
    weights: Tensor  # [t, TILE * TILE, k] f32


def _project(splats: Splats, camera: Camera) -> _Footprints:
    """EWA projection of all splats at once (float64: it costs little here), those out of sight left out."""
    pose = torch.tensor(camera.viewmat[:3])
    point = splats.means.double() @ pose[:, :3].T + pose[:, 3]
    opacity = torch.sigmoid(splats.opacity_logits.double())
    kept = torch.nonzero((point[:, 2] >= NEAR_PLANE) & (opacity >= ALPHA_FLOOR))[:, 0]
    kept = kept[torch.argsort(point[kept, 2].float(), stable=True)]
    (x, y, z), opacity = point[kept].T, opacity[kept]
    bounds = [
        (-c / f - FIELD_MARGIN * 0.5 * size / f, (size - c) / f + FIELD_MARGIN * 0.5 * size / f)
        for f, c, size in ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    ]
    u, v = (x / z).clamp(*bounds[0]), (y / z).clamp(*bounds[1])
    axes = pose[:, :3] @ _rotations(splats.quats[kept].double()) * splats.log_scales[kept].double().exp()[:, None]
    across = (axes[:, 0] - u[:, None] * axes[:, 2]) * (camera.fx / z)[:, None]
    down = (axes[:, 1] - v[:, None] * axes[:, 2]) * (camera.fy / z)[:, None]
    xx, xy, yy = (across**2).sum(1) + LOW_PASS, (across * down).sum(1), (down**2).sum(1) + LOW_PASS
    conic = torch.stack([yy, -xy, xx], dim=1) / (xx * yy - xy**2)[:, None]
    mean = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    extent = (2 * torch.log(opacity / ALPHA_FLOOR)).sqrt()[:, None] * torch.stack([xx, yy], dim=1).sqrt()
    limits = torch.tensor([camera.width, camera.height])
    seen = ((mean + extent >= 0.5) & (mean - extent <= limits - 0.5)).all(dim=1)
    return _Footprints(kept[seen], *(part[seen].float() for part in (mean, conic, opacity, extent)))


def _rotations(quats: Tensor) -> Tensor:
    """[n, 3, 3] of quaternions w x y z of any length."""
    w, x, y, z = normalize(quats, dim=1).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def _lists(footprints: _Footprints, camera: Camera) -> tuple[Tensor, Tensor]:
    """Starts [tiles + 1] and items of every tile's list of footprints, near to far."""
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    most = torch.tensor([columns - 1, rows - 1])
    low = ((footprints.mean - footprints.extent - 0.5).ceil() // TILE).long().clamp(min=0)
    high = torch.minimum(((footprints.mean + footprints.extent - 0.5).floor() // TILE).long(), most)
    span = (high - low + 1).clamp(min=0)
    counts = span.prod(dim=1)
    items = torch.repeat_interleave(torch.arange(len(counts)), counts)
    within = torch.arange(len(items)) - (counts.cumsum(0) - counts)[items]
    across = span[items, 0]
    tiles = (low[items, 1] + within // across) * columns + low[items, 0] + within % across
    tiles, order = torch.sort(tiles.int(), stable=True)
    lengths = torch.bincount(tiles, minlength=rows * columns)
    return pad(lengths.cumsum(0), (1, 0)), items[order]


def _add_view(view: _View, tiles: Tensor, sums: Tensor) -> None:
    """``A^T [B n]`` of some tiles of a view onto ``sums`` [P, F + 1]."""
    for slab in _slabs(view, tiles):
        _add_gradient(slab, view.target, sums)


def _slabs(view: _View, own: Tensor) -> Iterator[_Slab]:
    """The weights of a view's tiles ``own``, a slab of splats on a batch of tiles at a time, near to far on each."""
    camera, walk, footprints, (starts, items), _ = view
    lengths, columns = starts.diff(), -(-camera.width // TILE)
    light = by_tile(torch.ones(camera.height, camera.width, 1))[:, :, 0]
    depth = 0
    while True:
        left = own[(lengths[own] > depth) & (light[own].amax(dim=1) > walk.transmittance_stop)]
        if len(left) == 0:
            return
        left = left[torch.argsort(lengths[left], descending=True)]  # so that few slabs of a batch are padded
        for tiles in left.split(max(1, WEIGHTS // (SLAB * TILE * TILE))):
            offsets = torch.arange(depth, min(depth + SLAB, int(lengths[tiles[0]])))
            members = items[(starts[tiles, None] + offsets).clamp(max=len(items) - 1)]
            corners = torch.stack([tiles % columns, tiles // columns]) * TILE
            alphas = _alphas(footprints, members, offsets < lengths[tiles, None], corners)
            weights, light[tiles] = _composite(alphas.clamp_(max=walk.alpha_cap), light[tiles], walk)
            yield _Slab(tiles, footprints.splats[members], weights)
        depth += SLAB


def _alphas(footprints: _Footprints, members: Tensor, there: Tensor, corners: Tensor) -> Tensor:
    """[t, TILE * TILE, k] f32, the alphas of footprints ``members`` [t, k] on tiles from ``corners`` [2, t] px on.

    The quadratic form is a part by column, a part by row, and one product of both. ``there`` [t, k]: no padding.
    """
    dx, dy = (
        (corners[axis, :, None] + torch.arange(TILE) + 0.5)[:, :, None] - footprints.mean[:, axis][members][:, None]
        for axis in (0, 1)
    )
    xx, xy, yy = footprints.conic[members].permute(2, 0, 1)[:, :, None]
    level = torch.where(there, footprints.opacity[members].log(), -torch.inf)[:, None]
    by_column, by_row = -0.5 * xx * dx * dx, level - 0.5 * yy * dy * dy
    exponents = by_column[:, None] + by_row[:, :, None]
    exponents.addcmul_((-xy * dx)[:, None], dy[:, :, None])
    return threshold(exponents.exp_(), ALPHA_FLOOR, 0.0, inplace=True).flatten(1, 2)


def _composite(alphas: Tensor, light: Tensor, walk: CompositingParams) -> tuple[Tensor, Tensor]:
    """Weights [t, TILE * TILE, k] f32, made in place of the alphas, and the light [t, TILE * TILE] behind them."""
    after = 1 - alphas
    after[:, :, 0] *= light
    torch.cumprod(after, dim=2, out=after)
    alphas[:, :, 1:] *= after[:, :, :-1]
    alphas[:, :, 0] *= light
    if after[:, :, -1].amin() <= walk.transmittance_stop:
        alphas *= after > walk.transmittance_stop
    return alphas, after[:, :, -1]


def _add_gradient(slab: _Slab, target: Tensor, sums: Tensor) -> None:
    """The gradient of ``sum(render(x) B)`` for the splats of the slab onto ``sums`` [P, F + 1]."""
    distinct, places = torch.unique(slab.splats, return_inverse=True)
    first = 0
    pixels = target[slab.tiles]
    for part in pixels.tensor_split(-(-pixels.shape[2] // CHANNELS), dim=2):
        x = torch.zeros(len(distinct), part.shape[2], requires_grad=True)  # any x: the render is linear in it
        rendered = torch.bmm(slab.weights, embedding(places, x))
        (gradient,) = torch.autograd.grad(rendered, x, grad_outputs=part)
        sums[distinct, first : first + part.shape[2]] += gradient
        first += part.shape[2]


def by_tile(image: Tensor) -> Tensor:
    """[H, W, C] -> [tiles, TILE * TILE, C], zero beyond the image."""
    height, width, channels = image.shape
    padded = pad(image, (0, 0, 0, -width % TILE, 0, -height % TILE))
    tiles = padded.reshape(padded.shape[0] // TILE, TILE, padded.shape[1] // TILE, TILE, channels).transpose(1, 2)
    return tiles.reshape(-1, TILE * TILE, channels)
