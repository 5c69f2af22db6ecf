"""The peer on a card: gsplat's renderer, and the lift as a gradient that autograd takes through it.

``d/dX sum(render(X) B) = A^T B`` for a linear render, and ``A^T n`` of one channel more, as people lift who have a
differentiable rasterizer. gsplat is no dependency: ``pip install gsplat==1.5.3`` makes this peer appear, and its CUDA
code is compiled at its first call, which needs nvcc. Its alphas are capped at 0.999 (up to 1.5.3) where ours are
at 0.99, so the two agree but for splats that are nearly opaque.
"""

from __future__ import annotations

import importlib.util
import statistics
import time
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import torch

from liftcore.device import choose_device
from liftcore.errors import Unavailable
from liftcore.evaluate.region_walk import walk_regions
from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.features.views import Regions
from liftcore.progress import silent
from liftcore.raster.base import CompositingParams, Weighting
from liftcore.raster.open_raster import open_raster
from liftcore.solve.host import Host
from liftcore.solve.solver import closed_form
from liftcore.solve.view_weights import WeightStore

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.device import Device
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats
    from tests.benchmarks.gpu.room_files import RoomSize

Views = list[tuple["Camera", Regions]]
ROUNDS = 3  # both in turn, after one round that is not counted


@dataclass(frozen=True)
class SideBySide:
    """Both on the same work, in one process."""

    gsplat: str  # its version
    ours_s: float  # median seconds of all views, geometry and solution
    theirs_s: float
    cosine: float  # of a splat's two features, the mean by evidence


def missing() -> str:
    """Why the peer cannot run here, in words; empty when it can."""
    try:
        choose_device("cuda")
    except Unavailable as error:
        return f"gsplat needs a card: {error.got}"
    if importlib.util.find_spec("gsplat") is None:
        return "the package gsplat is not installed (pip install gsplat==1.5.3)"
    return ""


def beside_gsplat(size: RoomSize, device: Device) -> SideBySide | str:
    """Both lifts of the synthetic room in turns; in words why not, where gsplat does not run."""
    lacking = missing()
    if lacking:
        return lacking
    splats = room_splats(size.splats)
    cameras = room_cameras(size.views, size.width, size.height)
    views = [(camera, at_pixels(room_regions(camera, k, size.levels, size.channels), camera))
             for k, camera in enumerate(cameras)]  # fmt: skip
    seconds: dict[str, list[float]] = {"ours": [], "theirs": []}
    ours = theirs = (torch.zeros(0), torch.zeros(0))
    for _ in range(1 + ROUNDS):
        start = time.perf_counter()
        ours = lift_ours(splats, views, device)
        middle = time.perf_counter()
        try:
            theirs = lift_theirs(import_module("gsplat").rasterization, splats, views, device.place)
        except (RuntimeError, OSError, ImportError, AttributeError, TypeError) as error:
            # What its compiler, its version or the card's memory says; a figure is not put in its place.
            return f"gsplat did not run: {type(error).__name__}: {' '.join(str(error).split())[:300]}"
        seconds["ours"].append(middle - start)
        seconds["theirs"].append(time.perf_counter() - middle)
    medians = {name: statistics.median(values[1:]) for name, values in seconds.items()}
    cosines = torch.nn.functional.cosine_similarity(ours[0], theirs[0], dim=1).double()
    cosine = float((cosines * ours[1]).sum() / ours[1].sum())
    return SideBySide(_version(), medians["ours"], medians["theirs"], cosine)


def lift_ours(splats: Splats, views: Views, device: Device) -> tuple[Tensor, Tensor]:
    """X [P, F] f32 and the totals [P] f64 of plain weights, by region weights and the closed form."""
    with WeightStore() as store:
        looking = CompositingParams(), Weighting()
        totals, columns = walk_regions(open_raster(splats, device), views, looking, splats.count, store)
        host = Host(means=splats.means)
        X = closed_form(store, columns, totals, torch.float32, silent, device, host).features
    return X, torch.from_numpy(totals)


def lift_theirs(rasterization: Any, splats: Splats, views: Views, place: torch.device) -> tuple[Tensor, Tensor]:
    """The same as a gradient through ``gsplat.rasterization``."""
    means, quats = splats.means.to(place), splats.quats.to(place)
    scales, opacities = splats.log_scales.exp().to(place), torch.sigmoid(splats.opacity_logits).to(place)
    channels = views[0][1].codebook.shape[1]
    X = torch.zeros(splats.count, channels + 1, device=place, requires_grad=True)
    for camera, regions in views:
        intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        pose = torch.tensor(camera.viewmat, dtype=torch.float32)
        rendered, _, _ = rasterization(
            means, quats, scales, opacities, X, pose[None].to(place), intrinsics.float()[None].to(place),
            camera.width, camera.height, packed=False,
        )  # fmt: skip
        (rendered[0] * dense_target(regions, place)).sum().backward()  # adds to what the views before left
    assert X.grad is not None
    sums = X.grad
    totals = sums[:, -1:]
    features = torch.where(totals > 0, sums[:, :-1] / totals.clamp_min(1e-30), 0.0)
    return features.cpu(), totals[:, 0].double().cpu()


def dense_target(regions: Regions, place: torch.device) -> Tensor:
    """B and n of every pixel, [H, W, F + 1] f32: the sum of the codebook rows of its labels, and their number."""
    book = regions.codebook.to(place).float()
    book = torch.cat([book, torch.ones(book.shape[0], 1, device=place)], dim=1)
    book = torch.cat([book, torch.zeros(1, book.shape[1], device=place)])  # the last is what no label reads
    labels = regions.labels.to(place).long()
    target = torch.zeros(*labels.shape[1:], book.shape[1], device=place)
    for level in torch.where(labels < 0, book.shape[0] - 1, labels):
        target += book[level]
    return target


def at_pixels(regions: Regions, camera: Camera) -> Regions:
    """The regions with a label a pixel."""
    height, width = regions.labels.shape[1:]
    y = (2 * torch.arange(camera.height) + 1) * height // (2 * camera.height)
    x = (2 * torch.arange(camera.width) + 1) * width // (2 * camera.width)
    return Regions(regions.labels[:, y][:, :, x].contiguous(), regions.codebook)


def _version() -> str:
    try:
        return version("gsplat")
    except PackageNotFoundError:
        return "unknown"
