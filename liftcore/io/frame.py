"""The frame of the splats, where a trainer moved the cameras before it trained, as nerfstudio and gsplat do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidCameras
from liftcore.io.json_file import entry, matrix, number, read_json
from liftcore.scene.cameras import Cameras

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

FRAME_FILE = "dataparser_transforms.json"  # as nerfstudio names it, in the folder of a run
OWN_FRAME = (
    "poses of nerfstudio's own files: it trains in another frame than they are in, unless it was told "
    f"--orientation-method none --center-method none --auto-scale-poses False. Put its run's {FRAME_FILE} beside them"
)
TOLERANCE = 1e-3  # of a rotation's entries: they were float32 on the way
LEAST, LARGEST = 1e-9, 1e9  # scales


@dataclass(frozen=True)
class Similarity:
    """A map between frames: ``p' = scale rotation p + translation``."""

    scale: float
    rotation: np.ndarray  # [3, 3] f64, proper
    translation: np.ndarray  # [3] f64

    @classmethod
    def of(cls, moved: np.ndarray, source: str) -> Similarity:
        """The map of an affine matrix [4, 4] f64.

        Raises:
            InvalidCameras: it does more than turn, shift and scale.
        """
        linear = moved[:3, :3]
        scale = float(np.cbrt(np.linalg.det(linear)))
        if not LEAST <= scale <= LARGEST or not np.isfinite(moved).all():
            expected = f"a proper rotation with a scale in {LEAST:g}..{LARGEST:g}"
            raise InvalidCameras(source, expected=expected, got=f"a determinant of {np.linalg.det(linear):.3g}")
        error = float(np.abs(linear @ linear.T / scale**2 - np.eye(3)).max())
        if error > TOLERANCE:
            raise InvalidCameras(
                source, expected="a rotation, a shift and a scale", got=f"a matrix off by {error:.2g}"
            )
        left, _, right = np.linalg.svd(linear)  # the nearest rotation
        return cls(scale, left @ right, moved[:3, 3])

    def moved(self, cameras: Cameras) -> Cameras:
        """The same views of the moved scene: every pixel shows what it showed.

        Of ``x = R p + t`` in a camera it makes ``R' = R rotation^T`` and ``t' = scale t - R' translation``, so that
        x' is scale x.
        """
        views = []
        for camera in cameras.values():
            pose = np.eye(4)
            pose[:3, :3] = camera.viewmat[:3, :3] @ self.rotation.T
            pose[:3, 3] = self.scale * camera.viewmat[:3, 3] - pose[:3, :3] @ self.translation
            views.append(replace(camera, viewmat=pose))
        return Cameras(tuple(views), frame=FRAME_FILE)


def read_frame(path: Path, applied: Mapping[str, Any], source: str) -> Similarity:
    """The map from the frame of camera files to that of the splats.

    The file holds ``transform`` T [3, 4] and ``scale`` s, which take the frame of the COLMAP model to that of the
    splats. Poses of a transforms.json have moved from there already, by its ``applied_transform`` A and
    ``applied_scale`` a. What is left is ``(s / a) T A^-1``, as nerfstudio's data parser moves them.

    Args:
        path: a ``FRAME_FILE``. applied: the transforms.json that the cameras are of; empty of a COLMAP model.
        source: the name of that file.

    Raises:
        InvalidCameras: a matrix or a scale is missing, malformed, or does more than turn, shift and scale.
    """
    document = read_json(path)
    moved = _affine(entry(document, "transform", str(path)), f"{path} transform")
    scale = _scale(entry(document, "scale", str(path)), f"{path} scale")
    before = np.eye(4)
    if applied.get("applied_transform") is not None:
        before = _affine(applied["applied_transform"], f"{source} applied_transform")
        Similarity.of(before, f"{source} applied_transform")
    left = moved @ np.linalg.inv(before)
    left[:3] *= scale / _scale(applied.get("applied_scale", 1.0), f"{source} applied_scale")
    return Similarity.of(left, f"{path} transform")


def frame_warning(cameras: Cameras) -> list[str]:
    """What is to be said of cameras that may not be in the frame of their splats."""
    return [OWN_FRAME] if cameras.of_nerfstudio else []


def _affine(value: Any, source: str) -> np.ndarray:
    found = np.eye(4)
    found[:3] = matrix(value, (3, 4), 4, source)[:3]
    if float(np.abs(found).max()) > LARGEST:
        raise InvalidCameras(source, expected=f"numbers within {LARGEST:g}", got=f"{float(np.abs(found).max()):.2g}")
    return found


def _scale(value: Any, source: str) -> float:
    scale = number(value, source)
    if not LEAST <= scale <= LARGEST:
        raise InvalidCameras(source, expected=f"a scale in {LEAST:g}..{LARGEST:g}", got=f"{scale:g}")
    return scale
