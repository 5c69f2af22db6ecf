"""Other ways to lift the same features onto the same splats, on the CPU, beside ours.

    python -m tests.benchmarks.peers [--sizes large channels] [--rounds N] [--json]

All lift ``X = (A^T B) / (A^T n)`` of a synthetic room with label maps of 4 levels over random unit codebooks: B sums
the codebook rows that a ray's levels read, n counts them. Each starts from splats, cameras, label maps and codebooks;
the others make an image of all channels a view first, and have our projection and tile lists, so that what differs
is the accumulation alone. Seconds are the median of the rounds, taken in turns; a peer whose lift takes longer than
LONG is not asked for more. Cosine: of a splat's feature with ours, the mean by total weight.

- ours: region weights ``A^T S`` once a view, then the closed form for all channels.
- dense numba: for each weight of a pixel, ``w b`` of all channels onto the splat's own, compiled.
- torch autograd: ``d/dx sum(render(x) B) = A^T B`` with a tiled renderer of torch operations.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.nn.functional import cosine_similarity, embedding, embedding_bag, pad, threshold

import liftcore as lc
from liftcore.evaluate.bench import weigh_regions
from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.raster import open_raster
from liftcore.raster.cpu.composite import Frame
from liftcore.raster.cpu.project import CUTOFF, MX, MY, OPACITY, SLOPE, SQRT_A, C
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.runtime.cores import cores
from liftcore.runtime.device import CPU, Device
from liftcore.runtime.one_thread import one_thread
from liftcore.scene.compositing import ALPHA_FLOOR, TILE, Weighting
from liftcore.solve.closed_form import solve
from liftcore.values.views import cells_under
from tests.benchmarks.base import command_line, print_rows
from tests.benchmarks.scenes import RoomSpec

LONG = 60.0  # seconds
THREADS = cores()


TINY = RoomSpec(500, 1, (64, 48), 4)  # to load kernels and start threads
SIZES = {
    "large": [RoomSpec(200_000, 2, (640, 480), 512)],
    "channels": [RoomSpec(20_000, 4, (200, 150), channels) for channels in (4, 16, 64, 256, 1024)],
}


@dataclass(frozen=True)
class Work:
    """One scene, its views with label maps and codebooks, and how rays are composited."""

    splats: lc.Splats
    views: tuple[tuple[lc.Camera, lc.Regions], ...]
    params: lc.CompositingParams = field(default_factory=lc.CompositingParams)

    @property
    def channels(self) -> int:
        """F."""
        return self.views[0][1].codebook.shape[1]


Answer = tuple[Tensor, Tensor]  # X [P, F] f32, zero where no ray met the splat; A^T n [P] f64 over all views


def room_work(size: RoomSpec) -> Work:
    """The synthetic room of ``splatlift bench`` at a size, always the same."""
    cameras = room_cameras(size.views, *size.size)
    views = tuple((camera, room_regions(camera, k, 4, size.channels)) for k, camera in enumerate(cameras))
    return Work(room_splats(size.splats), views)


def at_pixels(regions: lc.Regions, camera: lc.Camera) -> lc.Regions:
    """The regions with a label a pixel."""
    rows, columns = regions.labels.shape[1:]
    y = cells_under(torch.arange(camera.height), camera.height, rows)
    x = cells_under(torch.arange(camera.width), camera.width, columns)
    return lc.Regions(regions.labels[:, y][:, :, x].contiguous(), regions.codebook)


def dense_target(regions: lc.Regions, place: torch.device = CPU.place) -> Tensor:
    """B and n of every pixel, [H, W, F + 1] f32, n last: levels are added up, a quarter of a peer's work."""
    count, channels = regions.codebook.shape
    book = torch.zeros(count + 1, channels + 1, device=place)  # its last row is what an unlabelled level reads
    book[:count, :channels] = regions.codebook.to(place)
    book[:count, channels] = 1.0
    labels = regions.labels.to(place).flatten(1).T
    target = embedding_bag(torch.where(labels >= 0, labels, count), book, mode="sum")
    return target.reshape(*regions.labels.shape[1:], channels + 1)


def answer_of(sums: Tensor) -> Answer:
    """X from ``A^T [B n]`` [P, F + 1] f32."""
    totals = sums[:, -1:]
    return torch.where(totals > 0, sums[:, :-1] / totals, 0.0), totals[:, 0].double()


def splatlift_answer(work: Work, device: Device = CPU) -> Answer:
    """As ``splatlift lift --preset row-sum --set dtype=float32`` has it."""
    raster, looking = open_raster(work.splats, device), (work.params, Weighting())
    W, codebook = weigh_regions(raster, work.views, looking, work.splats.count)
    solution = solve(W, codebook, torch.float32, means=work.splats.means, device=device)
    return solution.features, W.row_sums().cpu()


# --- dense numba ---

SHARES = 32  # of the tiles, dealt out to the threads in turn


def dense_numba(work: Work) -> Answer:
    """Tile by tile, splat by splat, pixel by pixel, channel by channel; each thread has sums of its own."""
    raster = CpuRaster(work.splats, THREADS)
    partial_sums = np.zeros((THREADS, work.splats.count, work.channels + 1), np.float32)
    with ThreadPoolExecutor(THREADS) as pool:
        for camera, regions in work.views:
            (frame,) = raster._bands(camera, work.params)
            target = dense_target(at_pixels(regions, camera)).numpy()
            marks = np.linspace(0, frame.starts[-1], SHARES + 1)  # about as many list items a share
            edges = np.searchsorted(frame.starts, marks).clip(0, frame.columns * frame.rows)
            parts = [
                pool.submit(_add_shares, k, THREADS, edges, frame, target, partial_sums[k]) for k in range(THREADS)
            ]
            for part in parts:
                part.result()
    return answer_of(torch.from_numpy(partial_sums.sum(axis=0)))


@njit(nogil=True, cache=True)
def _add_shares(thread, threads, edges, frame, target, sums):
    """``A^T [B n]`` of every ``threads``-th share of the tiles; target [H, W, F + 1], sums [P, F + 1] f32, grows."""
    transmittance = np.empty((TILE, TILE), np.float32)
    for share in range(thread, edges.shape[0] - 1, threads):
        for tile in range(edges[share], edges[share + 1]):
            x0, y0 = tile % frame.columns * TILE, tile // frame.columns * TILE
            width, height = min(TILE, frame.width - x0), min(TILE, frame.height - y0)
            transmittance[:] = 0
            transmittance[:height, :width] = 1
            for step in range(frame.starts[tile], frame.starts[tile + 1]):
                if (step - frame.starts[tile]) % 16 == 0 and transmittance.max() <= 0:
                    break
                place = frame.items[step]
                box = x0, y0, width, height
                _add_splat(frame, frame.projected[place], box, transmittance, target, sums[frame.ids[place]])


@njit(nogil=True, cache=True)
def _add_splat(frame, record, box, transmittance, target, row):
    """One splat's weights on one tile, times the pixels, onto its row of sums [F + 1]; light ends at 0."""
    x0, y0, width, height = box
    opacity, kx, cap = np.float32(record[OPACITY]), np.float32(record[SQRT_A] ** 2), np.float32(frame.alpha_cap)
    for y in range(height):
        dy = y0 + y + 0.5 - record[MY]
        base = record[C] * dy * dy
        if base > record[CUTOFF]:
            continue
        centre = record[MX] + record[SLOPE] * dy - x0 - 0.5
        half = math.sqrt(record[CUTOFF] - base) / record[SQRT_A]
        for x in range(max(0, math.ceil(centre - half)), min(width - 1, math.floor(centre + half)) + 1):
            before = transmittance[y, x]
            if before <= 0:
                continue
            dx = np.float32(x - centre)
            alpha = opacity * np.exp2(-(kx * dx * dx + np.float32(base)))
            if alpha < np.float32(ALPHA_FLOOR):
                continue
            alpha = min(alpha, cap)
            after = before * (np.float32(1) - alpha)
            if after <= np.float32(frame.transmittance_stop):
                transmittance[y, x] = 0
                continue
            transmittance[y, x] = after
            _add_scaled(row, alpha * before, target[y0 + y, x0 + x])


@njit(nogil=True, cache=True, fastmath={"contract"})
def _add_scaled(row, weight, pixel):
    """``row += weight pixel``, all channels: the inner loop, eight channels an instruction."""
    for channel in range(row.shape[0]):
        row[channel] += weight * pixel[channel]


# --- torch autograd ---

SLAB = 128  # splats along the depth of a tile at a time
WEIGHTS = 1 << 20  # of a batch of slabs: 4 MiB an intermediate
CHANNELS = 128  # a chunk


def torch_autograd(work: Work) -> Answer:
    """View by view, slab by slab, chunk by chunk of channels; each thread has tiles and sums of its own."""
    raster = CpuRaster(work.splats, THREADS)
    partial_sums = torch.zeros(THREADS, work.splats.count, work.channels + 1)
    one_each = {"initializer": torch.set_num_threads, "initargs": (1,)}
    with one_thread(), ThreadPoolExecutor(THREADS, **one_each) as pool:
        for camera, regions in work.views:
            (frame,) = raster._bands(camera, work.params)
            target = by_tile(dense_target(at_pixels(regions, camera)))
            tiles = torch.arange(len(target))
            parts = [
                pool.submit(_add_view, frame, target, tiles[k::THREADS], sums) for k, sums in enumerate(partial_sums)
            ]
            for part in parts:
                part.result()
    return answer_of(partial_sums.sum(dim=0))


def _add_view(frame: Frame, target: Tensor, own_tiles: Tensor, sums: Tensor) -> None:
    """Add ``A^T [B n]`` of the tiles ``own_tiles`` [n], in batches, to sums [P, F + 1].

    Args:
        target: [tiles, TILE^2, F + 1] f32.
    """
    starts, items = torch.from_numpy(frame.starts), torch.from_numpy(frame.items)
    ids, lengths = torch.from_numpy(frame.ids), starts.diff()
    transmittance = by_tile(torch.ones(frame.height, frame.width, 1))[:, :, 0]
    depth = 0
    while True:
        is_open = transmittance[own_tiles].amax(dim=1) > frame.transmittance_stop
        remaining = own_tiles[(lengths[own_tiles] > depth) & is_open]
        if len(remaining) == 0:
            return
        remaining = remaining[torch.argsort(lengths[remaining], descending=True)]  # little padding in a batch
        for tiles in remaining.split(max(1, WEIGHTS // (SLAB * TILE * TILE))):
            offsets = torch.arange(depth, min(depth + SLAB, int(lengths[tiles[0]])))
            members = items[(starts[tiles, None] + offsets).clamp(max=len(items) - 1)].long()
            alphas = _alphas(frame, members, offsets < lengths[tiles, None], tiles)
            weights, transmittance[tiles] = _composite(
                alphas.clamp_(max=frame.alpha_cap), transmittance[tiles], frame
            )
            _add_gradient(weights, ids[members], target[tiles], sums)
        depth += SLAB


def _alphas(frame: Frame, members: Tensor, present: Tensor, tiles: Tensor) -> Tensor:
    """Compute the alphas [t, TILE^2, k] f32 of splats ``members`` [t, k] on tiles [t]; present [t, k]: no padding."""
    projected = torch.from_numpy(frame.projected)[members]  # [t, k, COLUMNS] f64
    x, y = (
        (corner[:, None] * TILE + torch.arange(TILE) + 0.5)[:, :, None] - projected[:, None, :, centre]
        for corner, centre in ((tiles % frame.columns, MX), (tiles // frame.columns, MY))
    )
    root = projected[:, None, :, SQRT_A]
    across = (root * x).float()[:, None] - (root * projected[:, None, :, SLOPE] * y).float()[:, :, None]
    exponents = across.square_().add_((projected[:, None, :, C] * y * y).float()[:, :, None])
    opacity = torch.where(present, projected[:, :, OPACITY], 0.0).float()
    return threshold(exponents.neg_().exp2_() * opacity[:, None, None], ALPHA_FLOOR, 0.0).flatten(1, 2)


def _composite(alphas: Tensor, transmittance: Tensor, frame: Frame) -> tuple[Tensor, Tensor]:
    """Weights [t, TILE^2, k] f32, made in place of the alphas, and the transmittance [t, TILE^2] behind them."""
    after = 1 - alphas
    after[:, :, 0] *= transmittance
    torch.cumprod(after, dim=2, out=after)
    alphas[:, :, 1:] *= after[:, :, :-1]
    alphas[:, :, 0] *= transmittance
    if after[:, :, -1].amin() <= frame.transmittance_stop:
        alphas *= after > frame.transmittance_stop
    return alphas, after[:, :, -1]


def _add_gradient(weights: Tensor, splats: Tensor, pixels: Tensor, sums: Tensor) -> None:
    """The gradient of ``sum(render(x) B)`` for splats [t, k] of weights [t, TILE^2, k] onto ``sums`` [P, F + 1]."""
    distinct, places = torch.unique(splats, return_inverse=True)
    first = 0
    for part in pixels.tensor_split(-(-pixels.shape[2] // CHANNELS), dim=2):
        x = torch.zeros(len(distinct), part.shape[2], requires_grad=True)  # any x: the render is linear in it
        rendered = torch.bmm(weights, embedding(places, x))
        (gradient,) = torch.autograd.grad(rendered, x, grad_outputs=part)
        sums[distinct, first : first + part.shape[2]] += gradient
        first += part.shape[2]


def by_tile(image: Tensor) -> Tensor:
    """[H, W, C] -> [tiles, TILE * TILE, C], zero beyond the image."""
    height, width, channels = image.shape
    padded = pad(image, (0, 0, 0, -width % TILE, 0, -height % TILE))
    tiles = padded.reshape(padded.shape[0] // TILE, TILE, padded.shape[1] // TILE, TILE, channels).transpose(1, 2)
    return tiles.reshape(-1, TILE * TILE, channels)


# --- side by side ---

PEERS: dict[str, Callable[[Work], Answer]] = {
    "splatlift": splatlift_answer, "dense numba": dense_numba, "torch autograd": torch_autograd,
}  # fmt: skip


def side_by_side(
    size: RoomSpec, work: Work, peers: Mapping[str, Callable[[Work], Answer]], rounds: int
) -> Iterator[dict[str, Any]]:
    """A row a peer: all lift the work in turns, a round of all, then the next; each is held to the first's X."""
    seconds: dict[str, list[float]] = {name: [] for name in peers}
    answers: dict[str, Answer] = {}
    for _ in range(rounds):
        for name, lift in peers.items():
            if max(seconds[name], default=0.0) < LONG:
                start = time.perf_counter()
                answers[name] = lift(work)
                seconds[name].append(time.perf_counter() - start)
    features, total_weight = answers["splatlift"]
    baseline = statistics.median(seconds["splatlift"])
    for name, (peer_answer, _) in answers.items():
        median = statistics.median(seconds[name])
        cosines = cosine_similarity(features, peer_answer, dim=1).double()
        yield {
            "splats": size.splats, "image": "x".join(map(str, size.size)), "views": size.views,
            "channels": size.channels, "peer": name, "seconds": median, "fastest": min(seconds[name]),
            "times ours": median / baseline, "cosine": float((cosines * total_weight).sum() / total_weight.sum()),
        }  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = command_line(
        "tests.benchmarks.peers",
        __doc__,
        ("--sizes", {"nargs": "+", "choices": list(SIZES), "default": ["large"], "help": "what grows"}),
        ("--rounds", {"type": int, "default": 3}),
    )
    options = parser.parse_args()
    for lift in PEERS.values():
        lift(room_work(TINY))
    sizes = [size for name in options.sizes for size in SIZES[name]]
    rows = [row for size in sizes for row in side_by_side(size, room_work(size), PEERS, options.rounds)]
    print_rows(rows, as_json=options.json)


if __name__ == "__main__":
    main()
