"""The still life as splats and cameras: generated from a seed, the same at every run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.harmonics import SH_C0
from liftcore.scene.splats import Splats
from tests.still_life.objects import Piece, still_life_pieces
from tests.still_life.surfaces import Samples, sample

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator

WIDTH, HEIGHT, FOCAL = 480, 360, 430.0  # pixels
TARGET = np.array([0.0, 0.2, 1.0])  # decimetres, what the cameras look at
COVERAGE = 0.85  # standard deviation of a splat over the mean distance of its neighbours
STRETCH = 1.25  # a splat is longer along its surface's first direction by this, and narrower across
FLATNESS = 0.08  # thickness over width
LIGHT_POSITION = np.array([-5.0, -7.0, 9.0])  # decimetres, a window in front on the left
AMBIENT, WINDOW = 0.5, 0.6


@dataclass(frozen=True)
class StillLife:
    """A scene with the truth about every splat."""

    splats: Splats
    cameras: Cameras  # the lifted views and the held-out ones
    held_out: tuple[str, ...]  # names of the views without features
    objects: tuple[str, ...]  # object names
    parts: tuple[str, ...]  # part names
    object_of_part: tuple[int, ...]  # part -> object
    splat_parts: np.ndarray  # [P] i32, rows of parts

    @property
    def splat_objects(self) -> np.ndarray:
        """Return the object of each splat, [P] i32, rows of `objects`."""
        return np.array(self.object_of_part, dtype=np.int32)[self.splat_parts]


def still_life(
    seed: int = 7, views: int = 22, density: float = 1.0, pieces: Sequence[Piece] | None = None
) -> StillLife:
    """Build the scene.

    Args:
        seed: of everything random in it.
        views: number of cameras on the arc; every fifth is held out.
        density: share of the usual number of splats; fewer ones are larger.
        pieces: surfaces of the scene; None: the still life.
    """
    rng = np.random.default_rng(seed)
    base_pieces = still_life_pieces() if pieces is None else pieces
    pieces = [replace(piece, splats=max(1, round(density * piece.splats))) for piece in base_pieces]
    samples = [sample(piece.surface, piece.splats, rng) for piece in pieces]
    parts = tuple(dict.fromkeys(piece.part for piece in pieces))
    objects = tuple(dict.fromkeys(piece.object_name for piece in pieces))
    owner = {piece.part: objects.index(piece.object_name) for piece in pieces}
    cameras = arc(views)
    return StillLife(
        splats=_splats(pieces, samples, rng),
        cameras=cameras,
        held_out=tuple(camera.name for camera in list(cameras.values())[2::5]),
        objects=objects,
        parts=parts,
        object_of_part=tuple(owner[part] for part in parts),
        splat_parts=np.concatenate([np.full(piece.splats, parts.index(piece.part), np.int32) for piece in pieces]),
    )


def arc(views: int) -> Cameras:
    """Cameras on an arc in front of the table, in two heights by turns, all looking at its middle."""
    cameras = []
    for k in range(views):
        angle = np.radians(-52.0 + 104.0 * k / max(1, views - 1))
        lift = np.radians(24.0 if k % 2 == 0 else 36.0)
        offset = np.array([np.sin(angle) * np.cos(lift), -np.cos(angle) * np.cos(lift), np.sin(lift)])
        pose = _look_at(TARGET + 10.5 * offset)
        cameras.append(Camera.pinhole(f"view_{k:02d}", WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose))
    return Cameras(tuple(cameras))


def _look_at(centre: np.ndarray) -> np.ndarray:
    """[4, 4] world to camera (x right, y down, z forward) from a centre towards the target, z up."""
    forward = TARGET - centre
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def _splats(pieces: list[Piece], samples: list[Samples], rng: Generator) -> Splats:
    quats, scales, colours = [], [], []
    for piece, points in zip(pieces, samples, strict=True):
        frames = np.stack([points.tangents, points.bitangents, points.normals], axis=2)
        quats.append(_quaternions(frames))
        size = COVERAGE * _spacing(piece)
        widths = size * np.array([STRETCH, 1 / STRETCH, FLATNESS])
        scales.append(np.log(widths) + 0.1 * rng.standard_normal((len(points.points), 3)))
        colours.append(_shaded_colours(piece, points))
    logits = rng.normal(4.0, 0.8, sum(piece.splats for piece in pieces)).clip(1.0, 7.0)
    shades = np.concatenate(colours).clip(0.0, 1.0)
    return Splats(
        means=_column([points.points for points in samples]),
        quats=_column(quats),
        log_scales=_column(scales),
        opacity_logits=torch.from_numpy(logits.astype(np.float32)),
        sh=torch.from_numpy(((shades - 0.5) / SH_C0).astype(np.float32))[:, None, :],
    )


def _column(blocks: list[np.ndarray]) -> torch.Tensor:
    return torch.from_numpy(np.concatenate(blocks).astype(np.float32))


def _spacing(piece: Piece) -> float:
    """Mean distance of neighbours: the root of the area a splat."""
    grid = (np.arange(64) + 0.5) / 64
    u, v = (axis.ravel() for axis in np.meshgrid(grid, grid))
    h = 1e-4
    along = (piece.surface(u + h, v) - piece.surface(u - h, v)) / (2 * h)
    across = (piece.surface(u, v + h) - piece.surface(u, v - h)) / (2 * h)
    area = np.linalg.norm(np.cross(along, across), axis=1).mean()
    return float(np.sqrt(area / piece.splats))


def _shaded_colours(piece: Piece, points: Samples) -> np.ndarray:
    """[n, 3] colours: the piece's under an ambient light and a window (Lambert)."""
    towards = LIGHT_POSITION - points.points
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    cosine = np.abs((points.normals * towards).sum(axis=1))
    return np.array(piece.colour) * (AMBIENT + WINDOW * cosine[:, None])


def _quaternions(frames: np.ndarray) -> np.ndarray:
    """[n, 3, 3] rotations -> [n, 4] w x y z."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(frames).as_quat(scalar_first=True)
