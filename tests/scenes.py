"""Small scenes that tests share: random ones, and splats and cameras by hand."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from torch import Tensor

from liftcore.io.inria import write_inria_cameras
from liftcore.io.splats import write_splats
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Kernel, Splats
from liftcore.testing.scenes import look_at, of_kernel, random_camera, random_grid, random_regions, random_splats
from liftcore.values.pack import write_pack
from liftcore.values.views import ViewFeatures

__all__ = [
    "IDENTITY",
    "ROTATION",
    "ROW",
    "Kernel",
    "camera_at_origin",
    "centred",
    "look_at",
    "observed",
    "of_kernel",
    "random_camera",
    "random_grid",
    "random_regions",
    "random_splats",
    "scenes",
    "splats_at",
    "write_scene",
]

IDENTITY = (1.0, 0.0, 0.0, 0.0)
ROTATION = (0.9, 0.1, 0.3, 0.2)
ROW = tuple((0.3 * k - 0.6, 0.1 * k, 2.0 + 0.2 * k) for k in range(5))  # of five centres before a camera


def splats_at(
    means: Sequence[Sequence[float]] | np.ndarray,
    log_scales: ArrayLike = -2.0,
    logits: ArrayLike = 1.0,
    quats: ArrayLike = IDENTITY,
    kernel: Kernel = Kernel.GAUSSIAN_3D,
    betas: ArrayLike = 0.0,
) -> Splats:
    """Grey splats at the means; what is given once holds for all of them. Three scales, whatever the kernel keeps."""

    def column(values: ArrayLike, shape: tuple[int, ...]) -> Tensor:
        return torch.tensor(np.broadcast_to(np.asarray(values, np.float32), shape).copy())

    count = len(means)
    splats = Splats(
        column(np.asarray(means), (count, 3)),
        column(quats, (count, 4)),
        column(log_scales, (count, 3)),
        column(logits, (count,)),
        sh=torch.zeros(count, 1, 3),
    )
    return of_kernel(splats, kernel, column(betas, (count,)))


def camera_at_origin(width: int = 16, height: int = 12, focal: float = 16.0, name: str = "v0") -> Camera:
    """A camera that looks along +z, with the middle of a pixel on its axis."""
    centre = (width // 2 + 0.5, height // 2 + 0.5)
    return Camera.pinhole(name, width, height, focal, focal, *centre, np.eye(4))


def observed(seed: int, view: int, grids: bool = False) -> ViewFeatures:
    """Return the features of a view: a grid, or regions, which have tuples of labels in every second view."""
    if grids:
        return random_grid(seed + view)
    return random_regions(seed + view, levels=4, rows=9) if view % 2 else random_regions(seed + view)


@st.composite
def scenes(
    draw: st.DrawFn, kernel: Kernel = Kernel.GAUSSIAN_3D, max_splats: int = 60, largest: tuple[int, int] = (50, 40)
) -> tuple[Splats, Camera, ViewFeatures]:
    """A scene of at most so many splats, a view of at most that width and height, and what the view observes."""
    seed = draw(st.integers(0, 2**20))
    spread = draw(st.sampled_from([0.2, 1.0, 3.0]))
    splats = random_splats(seed, draw(st.integers(1, max_splats)), spread, kernel)
    camera = random_camera(seed, width=draw(st.integers(1, largest[0])), height=draw(st.integers(1, largest[1])))
    size = (draw(st.integers(1, 45)), draw(st.integers(1, 55)))
    if draw(st.booleans()):
        return splats, camera, random_grid(seed, size)
    return splats, camera, random_regions(seed, draw(st.integers(1, 4)), draw(st.integers(1, 9)), size)


def centred(camera: Camera) -> Camera:
    """The camera with its principal point at the image's centre, as Inria's files assume."""
    return Camera.pinhole(
        camera.name, camera.width, camera.height, camera.fx, camera.fy,
        camera.width / 2, camera.height / 2, camera.viewmat,
    )  # fmt: skip


def write_scene(
    folder: Path, seed: int, grids: bool = False, kernel: Kernel = Kernel.GAUSSIAN_3D
) -> tuple[Path, Path, Path]:
    """A random scene of three views on disk: splats, cameras, and features as ``observed`` gives them."""
    views = tuple(centred(random_camera(seed + k, 32 + 5 * k, 24 + 3 * k, name=f"v{k}")) for k in range(3))
    observations = {camera.name: observed(seed, k, grids) for k, camera in enumerate(views)}
    paths = folder / "splats.ply", folder / "cameras.json", folder / "features.safetensors"
    write_splats(paths[0], random_splats(seed, 50, kernel=kernel))
    write_inria_cameras(Cameras(views), paths[1])
    write_pack(paths[2], observations, {"encoder": "random"})
    return paths
