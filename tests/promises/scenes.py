"""Random scenes by public names: splats, cameras that look at them, and features of their views."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import liftcore as lc
import numpy as np
from safetensors.numpy import save_file

KERNELS = ("3dgs", "2dgs", "dbs")
CHANNELS = 6
WIDTH, HEIGHT = 32, 24


@dataclass(frozen=True)
class RandomScene:
    """Values of a scene, as `liftcore.lift` takes them."""

    splats: lc.Splats
    cameras: lc.Cameras
    views: dict[str, lc.Regions | lc.FeatureGrid]

    def arguments(self) -> tuple[Any, Any, Any]:
        """Return the first three arguments of a lift."""
        return self.splats, self.cameras, self.views


def random_splats(
    seed: int, count: int, kernel: str = "3dgs", degree: int = 0, flat: float = 1.0, *, spread: float = 1.0,
    sizes: tuple[float, float] = (-4, -0.8), colours: float = 0.5, falloffs: float = 1.0,
) -> lc.Splats:  # fmt: skip
    """Return splats around the origin, from needles to balls and from faint to opaque; z times ``flat``."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int, scale: float = 1.0) -> np.ndarray:
        return rng.normal(0, scale, (count, *shape)).astype(np.float32)

    means, quats = normal(3, scale=spread) * np.array([1, 1, flat], np.float32), normal(4)
    log_scales, logits = rng.uniform(*sizes, (count, 3)).astype(np.float32), normal(scale=3)
    sh, betas = normal((degree + 1) ** 2, 3, scale=colours), normal(scale=falloffs)
    if kernel == "2dgs":
        log_scales = log_scales[:, :2]
    return lc.Splats(means, quats, log_scales, logits, kernel, sh=sh, beta=betas if kernel == "dbs" else None)


def look_at(centre: np.ndarray, name: str = "", width: int = WIDTH, height: int = HEIGHT) -> lc.Camera:
    """Return a camera at ``centre`` [3] that looks at the origin, its principal point beside the middle."""
    forward = -centre / np.linalg.norm(centre)
    right = np.cross([0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0], forward)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ centre
    K = np.array([[width, 0, width / 2 + 0.7], [0, width * 1.1, height / 2 - 0.4], [0, 0, 1.0]])
    return lc.Camera(viewmat, K, width, height, name=name)


def plane_under_pixels(camera: lc.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y [H, W] of the plane z = 0 at the centre of each pixel."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([u, v, np.ones(u.shape)], axis=-1) @ np.linalg.inv(camera.K).T @ camera.viewmat[:3, :3]
    points = camera.centre - rays * (camera.centre[2] / rays[..., 2:])
    return points[..., 0], points[..., 1]


def halves_and_quarters(camera: lc.Camera, rng: np.random.Generator, wrong: float) -> np.ndarray:
    """Return labels [2, H, W]: halves 0 and 1 of the plane z = 0, and its quarters 2 to 5; a share is wrong."""
    x, y = plane_under_pixels(camera)
    labels = np.stack([x > 0, 2 + (x > 0) + 2 * (y > 0)]).astype(np.int32)
    other_items = np.stack([rng.integers(-1, 2, x.shape), rng.choice([-1, 2, 3, 4, 5], x.shape)])
    return np.where(rng.random(labels.shape) < wrong, other_items, labels).astype(np.int32)


def regions_of(camera: lc.Camera, rng: np.random.Generator, wrong: float = 0.05) -> lc.Regions:
    """Return the halves and quarters with a unit vector each, another in every view."""
    codebook = np.eye(6, CHANNELS) + rng.normal(0, 0.2, (6, CHANNELS))
    codebook /= np.linalg.norm(codebook, axis=1, keepdims=True)
    return lc.Regions(halves_and_quarters(camera, rng, wrong), codebook.astype(np.float32))


def random_grid(rng: np.random.Generator, height: int = 6, width: int = 8) -> lc.FeatureGrid:
    """Return a map [height, width, CHANNELS] of random vectors."""
    return lc.FeatureGrid(rng.normal(0, 1, (height, width, CHANNELS)).astype(np.float32))


def random_scene(
    seed: int = 3, count: int = 300, views: int = 4, grids: bool = False, kernel: str = "3dgs", wrong: float = 0.05
) -> RandomScene:
    """Return a sheet of splats and views from before it: of regions on two levels, or of grids."""
    rng = np.random.default_rng(seed)
    names = [f"v{number}" for number in range(views)]
    cameras = {name: look_at(rng.normal((0, 0, -4), (0.8, 0.8, 0.2)), name) for name in names}
    maps = {name: random_grid(rng) if grids else regions_of(cameras[name], rng, wrong) for name in names}
    return RandomScene(random_splats(seed, count, kernel, flat=0.05), lc.Cameras(cameras), maps)


def write_pack(path: Path, views: dict[str, lc.Regions | lc.FeatureGrid], **metadata: str) -> Path:
    """Write a feature pack by its documented layout: NAME/grid, or NAME/labels and NAME/codebook."""
    tensors = {}
    for name, view in views.items():
        if isinstance(view, lc.Regions):
            tensors |= {f"{name}/labels": view.labels.numpy(), f"{name}/codebook": view.codebook.numpy()}
        else:
            tensors[f"{name}/grid"] = view.grid.numpy()
    save_file(tensors, path, metadata={"encoder": "random", **metadata})
    return path


class ShuffledEngine(lc.LocalEngine):
    """An engine that runs pieces in another order, and the first of them twice, as a cluster may."""

    def run(self, work: Any, pieces: Any, count: int) -> Iterator[int]:
        order = np.random.default_rng(count).permutation(count).tolist()
        for piece in [*order, order[0]]:
            work(pieces, piece, self.threads)
        yield from order


def arrays_of(result: lc.LiftResult) -> dict[str, tuple[Any, ...]]:
    """Return dtype, shape and bytes of every array of a lift, for comparisons to the bit."""
    return {name: (str(a.dtype), a.shape, a.tobytes()) for name, a in result.arrays().items()}
