"""Small scenes that tests share: random ones, and splats and cameras by hand."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from torch import Tensor

from liftcore.io.splats import write_splats
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Kernel, Splats
from liftcore.values.pack import write_pack
from liftcore.values.views import FeatureGrid, Regions, ViewFeatures
from tests.inria_file import write_inria_cameras
from tests.promises import scenes as random_scenes

IDENTITY = (1.0, 0.0, 0.0, 0.0)
ROTATION = (0.9, 0.1, 0.3, 0.2)
ROW = tuple((0.3 * k - 0.6, 0.1 * k, 2.0 + 0.2 * k) for k in range(5))  # of five centres before a camera


def of_kernel(splats: Splats, kernel: Kernel, betas: Tensor) -> Splats:
    """Return the splats as those of another kernel: 2DGS uses the first two scales, DBS the betas [P]."""
    if kernel is Kernel.GAUSSIAN_2D:
        return replace(splats, kernel=kernel, log_scales=splats.log_scales[:, :2].contiguous())
    return replace(splats, kernel=kernel, beta=betas) if kernel is Kernel.BETA else splats


def random_splats(seed: int, count: int = 40, spread: float = 1.0, kernel: Kernel = Kernel.GAUSSIAN_3D) -> Splats:
    """Return splats around the origin: needles, discs and balls, faint and opaque, with flat and steep falloffs."""
    options = {"spread": spread, "sizes": (-4.5, -0.5), "colours": 1.0, "falloffs": 1.5}
    return random_scenes.random_splats(seed, count, kernel, **options)


def look_at(name: str, centre: np.ndarray, width: int, height: int, focal: float) -> Camera:
    """Return a camera at ``centre`` that looks at the origin."""
    return random_scenes.look_at(centre, name, width, height).replace(fx=focal, fy=1.1 * focal)


def random_camera(seed: int, width: int = 37, height: int = 29, name: str = "v0") -> Camera:
    """Return a random camera around the scene; its size is no multiple of a tile."""
    rng = np.random.default_rng(seed + 1_000)
    direction = rng.normal(0, 1, 3)
    centre = direction / np.linalg.norm(direction) * rng.uniform(2.5, 5.0)
    return look_at(name, centre, width, height, focal=rng.uniform(0.7, 1.5) * width)


def random_regions(seed: int, levels: int = 2, rows: int = 5, size: tuple[int, int] = (15, 18)) -> Regions:
    """Return blocky label maps of another size than the image, with unlabelled pixels."""
    rng = np.random.default_rng(seed + 2_000)
    coarse = rng.integers(-1, rows, (levels, -(-size[0] // 3), -(-size[1] // 4)))
    labels = np.repeat(np.repeat(coarse, 3, axis=1), 4, axis=2)[:, : size[0], : size[1]]
    codebook = rng.normal(0, 1, (rows, random_scenes.CHANNELS))
    codebook /= np.linalg.norm(codebook, axis=1, keepdims=True)
    return Regions(torch.tensor(labels.copy(), dtype=torch.int32), torch.tensor(codebook, dtype=torch.float32))


def random_grid(seed: int, size: tuple[int, int] = (7, 9)) -> FeatureGrid:
    """Return a grid of random vectors."""
    return random_scenes.random_grid(np.random.default_rng(seed + 3_000), *size)


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


def camera_at_origin(width: int = 16, height: int = 12, focal: float = 16.0) -> Camera:
    """A camera that looks along +z, with the middle of a pixel on its axis."""
    centre = (width // 2 + 0.5, height // 2 + 0.5)
    return Camera.pinhole("v0", width, height, focal, focal, *centre, np.eye(4))


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
    return camera.replace(cx=camera.width / 2, cy=camera.height / 2)


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
