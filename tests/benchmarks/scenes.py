"""A scene to measure on: a synthetic room of many views, with known mistakes.

    python -m tests.benchmarks.scenes room FOLDER --splats 500000 --views 160

Every view of the room has regions on four levels, from walls and balls to their parts, seen with occlusion. A part
has a random unit vector; what a view says of it has noise of norm NOISE. Of all regions a tenth say another part's
vector, and of three tenths the vector is mixed with another's.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import liftcore as lc
from liftcore.io.splats import write_splats
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.values.pack import as_views, write_pack
from liftcore.values.views import NO_LABEL, ViewFeatures
from tests.inria_file import write_inria_cameras

NOISE = 0.45
WRONG, MERGED = 0.1, 0.3  # shares of a view's regions
SHRUNK = 2  # label maps have every other pixel
_HALF = 3.0  # scene units from the middle of the room to its walls
_BALLS = 12
PART_LEVELS = 4
_COVER = 1.6  # splat radius in mean distances between neighbours: surfaces without holes


@dataclass(frozen=True)
class RoomSpec:
    """The parameters of a room."""

    splats: int
    views: int
    size: tuple[int, int]  # width and height of the views, pixels
    channels: int
    seed: int = 0


def write_room(folder: Path, spec: RoomSpec) -> None:
    """Write ``point_cloud.ply``, ``cameras.json`` and ``features.safetensors``."""
    folder.mkdir(parents=True, exist_ok=True)
    splats, cameras = room_splats(spec.splats, spec.seed), room_cameras(spec.views, *spec.size)
    write_splats(folder / "point_cloud.ply", splats)
    write_inria_cameras(lc.Cameras(tuple(cameras)), folder / "cameras.json")
    views = as_views(observed_views(CpuRaster(splats), cameras, spec))
    write_pack(folder / "features.safetensors", views, {"encoder": "random parts", "normalised": "true"})


def observed_views(
    raster: CpuRaster, cameras: Sequence[lc.Camera], spec: RoomSpec
) -> Iterator[tuple[str, ViewFeatures]]:
    """Iterate over views by name, with their observed features."""
    parts = room_parts(spec.splats, spec.seed)  # [P, PART_LEVELS], numbers of parts on each level
    fine, counts = parts[:, -1], parts.max(axis=0) + 1
    shape = int(counts.sum()), spec.channels
    vectors = _unit_f32(np.random.default_rng((spec.seed, 1)).standard_normal(shape))  # level by level
    rows = np.full((PART_LEVELS, fine.max() + 2), NO_LABEL)  # of a finest part its vector on each level; none is last
    rows[:, fine] = (np.cumsum(counts) - counts + parts).T
    for number, camera in enumerate(cameras):
        rng = np.random.default_rng((spec.seed, number))
        labels = torch.from_numpy(fine.astype(np.int32))
        strongest = raster.strongest_labels(_shrunk(camera), labels, lc.CompositingParams()).numpy()
        visible_rows, labels = np.unique(rows[:, strongest], return_inverse=True)
        first = int(visible_rows[0] == NO_LABEL)
        vectors_seen = _noisy(_mistaken(vectors[visible_rows[first:]], vectors, rng), rng)
        yield (
            camera.name,
            lc.Regions(torch.from_numpy((labels - first).astype(np.int32)), torch.from_numpy(vectors_seen).half()),
        )


def _mistaken(book: np.ndarray, vectors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    other_vectors = vectors[rng.integers(0, len(vectors), len(book))]
    fate = rng.uniform(size=(len(book), 1))
    return _unit_f32(
        np.where(fate < WRONG, other_vectors, np.where(fate < WRONG + MERGED, book + other_vectors, book))
    )


def _noisy(book: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return _unit_f32(book + NOISE * _unit_f32(rng.standard_normal(book.shape)))


def _unit_f32(rows: np.ndarray) -> np.ndarray:
    return _unit(rows).astype(np.float32)


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def _shrunk(camera: lc.Camera) -> lc.Camera:
    sizes = {"width": camera.width // SHRUNK, "height": camera.height // SHRUNK}
    lengths = {name: getattr(camera, name) / SHRUNK for name in ("fx", "fy", "cx", "cy")}
    return camera.replace(**sizes, **lengths)


def room_splats(count: int, seed: int = 0) -> lc.Splats:
    """Make ``count`` splats on the inside of a cube and on balls in it; opacities mostly high, some low."""
    rng = np.random.default_rng(seed)
    points, normals, area, _ = _surfaces(rng, count)
    radius = _COVER * np.sqrt(area / count)
    scales = np.stack([np.full(count, radius), np.full(count, radius), np.full(count, radius * 0.05)], axis=1)
    scales *= rng.lognormal(0, 0.4, (count, 3))
    logits = rng.normal(1.5, 2.0, count)
    return lc.Splats(
        torch.tensor(points, dtype=torch.float32),
        torch.tensor(_quats_to(normals), dtype=torch.float32),
        torch.tensor(np.log(scales), dtype=torch.float32),
        torch.tensor(logits, dtype=torch.float32),
    )


def room_parts(count: int, seed: int = 0) -> np.ndarray:
    """Return the part of each splat of ``room_splats`` on each level: [P, PART_LEVELS] i64, from coarse to fine.

    A wall or a ball, then patches of the walls, 3, 6 and 12 a side, and half, quarter and eighth balls. Numbers are
    of a level.
    """
    points, normals, _, surface = _surfaces(np.random.default_rng(seed), count)
    across = np.where(normals == 0, points, 0.0) / (2 * _HALF) + 0.5  # on a wall, one of the three is of no account
    sides = (normals > 0) @ np.array([1, 2, 4])
    parts = [surface]
    for level in range(1, PART_LEVELS):
        patches = 3 * 2 ** (level - 1)
        grid = np.clip(across * patches, 0, patches - 1).astype(np.int64) * (normals == 0)
        wall = grid @ np.array([1, patches, patches**2])
        parts.append(surface * 2 * patches**3 + np.where(surface < 6, wall, sides % 2**level))
    return np.stack([np.unique(level, return_inverse=True)[1].reshape(-1) for level in parts], axis=1)


def room_cameras(count: int, width: int, height: int) -> list[lc.Camera]:
    """Make cameras on a circle near the walls that face the middle of the room."""
    cameras = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        centre = np.array([0.85 * _HALF * np.cos(angle), -0.3, 0.85 * _HALF * np.sin(angle)])
        forward = _unit(np.array([0.0, 0.1, 0.0]) - centre)
        right = _unit(np.cross([0.0, 1.0, 0.0], forward))
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
        focal = 0.8 * width
        cameras.append(lc.Camera.pinhole(f"room_{k:03d}", width, height, focal, focal, width / 2, height / 2, pose))
    return cameras


def _surfaces(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Sample points and normals [P, 3]; return the total area and each point's surface too: six walls, then balls."""
    on_balls = count // 3
    points, normals, face = _walls(rng, count - on_balls)
    centres = rng.uniform(-0.6 * _HALF, 0.6 * _HALF, (_BALLS, 3))
    radii = rng.uniform(0.2, 0.6, _BALLS)
    ball = rng.integers(0, _BALLS, on_balls)
    ball_normals = _unit(rng.normal(size=(on_balls, 3)))
    points = np.concatenate([points, centres[ball] + radii[ball, None] * ball_normals])
    normals = np.concatenate([normals, ball_normals])
    area = 6 * (2 * _HALF) ** 2 + float((4 * np.pi * radii**2).sum())
    return points, normals, area, np.concatenate([face, 6 + ball])


def _walls(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    face = rng.integers(0, 6, count)
    points = rng.uniform(-_HALF, _HALF, (count, 3))
    normals = np.zeros((count, 3))
    rows = np.arange(count)
    sign = np.where(face % 2 == 0, 1.0, -1.0)
    points[rows, face // 2] = sign * _HALF
    normals[rows, face // 2] = -sign
    return points, normals, face


def _quats_to(normals: np.ndarray) -> np.ndarray:
    """Return quaternions w x y z that rotate +z onto the normals."""
    w = 1 + normals[:, 2]
    flipped = w < 1e-6
    quats = np.stack([w, -normals[:, 1], normals[:, 0], np.zeros(len(w))], axis=1)
    quats[flipped] = [0.0, 1.0, 0.0, 0.0]
    return _unit(quats)


def main() -> None:
    """Write the scene."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.scenes", description=__doc__)
    spec = parser.add_subparsers(dest="kind", required=True).add_parser("room")
    spec.add_argument("folder", type=Path)
    for name, default in (("splats", 500_000), ("views", 160), ("width", 986), ("height", 728), ("channels", 512)):
        spec.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    size = options.width, options.height
    write_room(options.folder, RoomSpec(options.splats, options.views, size, options.channels))


if __name__ == "__main__":
    main()
