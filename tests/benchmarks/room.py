"""A synthetic room of any size for measurements of time: flat splats on walls, floor and a few balls."""

import numpy as np
import torch

from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats

_HALF = 3.0  # scene units from the middle of the room to its walls
_BALLS = 12
PART_LEVELS = 4
_COVER = 1.6  # splat radius in mean distances between neighbours: surfaces without holes


def room_splats(count: int, seed: int = 0) -> Splats:
    """Make ``count`` splats on the inside of a cube and on balls in it; opacities mostly high, some low."""
    rng = np.random.default_rng(seed)
    points, normals, area, _ = _surfaces(rng, count)
    radius = _COVER * np.sqrt(area / count)
    scales = np.stack([np.full(count, radius), np.full(count, radius), np.full(count, radius * 0.05)], axis=1)
    scales *= rng.lognormal(0, 0.4, (count, 3))
    logits = rng.normal(1.5, 2.0, count)
    return Splats(
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


def room_cameras(count: int, width: int, height: int) -> list[Camera]:
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
        cameras.append(Camera.pinhole(f"room_{k:03d}", width, height, focal, focal, width / 2, height / 2, pose))
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


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _quats_to(normals: np.ndarray) -> np.ndarray:
    """Return quaternions w x y z that rotate +z onto the normals."""
    w = 1 + normals[:, 2]
    flipped = w < 1e-6
    quats = np.stack([w, -normals[:, 1], normals[:, 0], np.zeros(len(w))], axis=1)
    quats[flipped] = [0.0, 1.0, 0.0, 0.0]
    return _unit(quats)
