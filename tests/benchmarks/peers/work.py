"""What every peer lifts: one scene, its views with label maps and codebooks, and how rays walk."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch.nn.functional import embedding_bag

from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.raster.base import CompositingParams

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

    from liftcore.features.views import Regions
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

LEVELS = 4  # of labels, as SAM's masks have them


@dataclass(frozen=True)
class Size:
    """How much there is to lift."""

    splats: int
    width: int  # pixels
    height: int  # pixels
    views: int
    channels: int


@dataclass(frozen=True)
class Work:
    """Lift ``X = (A^T B) / (A^T n)``: B [rays, F] sums the codebook rows that a ray's levels read, n counts them."""

    splats: Splats
    views: tuple[tuple[Camera, Regions], ...]
    threads: int
    walk: CompositingParams = field(default_factory=CompositingParams)

    @property
    def channels(self) -> int:
        """F."""
        return self.views[0][1].codebook.shape[1]


@dataclass(frozen=True)
class Answer:
    """What a peer lifted."""

    features: Tensor  # [P, F] f32, zero where no ray met the splat
    totals: Tensor  # [P] f64, ``A^T n`` over all views


def room(size: Size, threads: int) -> Work:
    """The synthetic room of ``splatlift bench`` at a size, always the same."""
    cameras = room_cameras(size.views, size.width, size.height)
    views = tuple((camera, room_regions(camera, k, LEVELS, size.channels)) for k, camera in enumerate(cameras))
    return Work(room_splats(size.splats), views, threads)


def dense_target(camera: Camera, regions: Regions) -> Tensor:
    """B and n of a view as an image [H, W, F + 1] f32, n last: what a peer without codebooks starts from.

    Levels are added up before the lift. It gives the same X as a pass a level, for a quarter of a peer's work.
    """
    rows, columns = regions.labels.shape[1:]
    y = (2 * torch.arange(camera.height) + 1) * rows // (2 * camera.height)
    x = (2 * torch.arange(camera.width) + 1) * columns // (2 * camera.width)
    labels = regions.labels[:, y][:, :, x].reshape(len(regions.labels), -1).T
    count, channels = regions.codebook.shape
    book = torch.zeros(count + 1, channels + 1)  # its last row is what an unlabelled level reads
    book[:count, :channels] = regions.codebook
    book[:count, channels] = 1.0
    target = embedding_bag(torch.where(labels >= 0, labels, count), book, mode="sum")
    return target.reshape(camera.height, camera.width, channels + 1)


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Torch's operations on so many threads, inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def answer_of(sums: Tensor) -> Answer:
    """X from ``A^T [B n]`` [P, F + 1] f32."""
    totals = sums[:, -1:]
    features = torch.where(totals > 0, sums[:, :-1] / totals, 0.0)
    return Answer(features, totals[:, 0].double())
