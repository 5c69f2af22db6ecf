"""The camera models of COLMAP: intrinsics and distortion, or a refusal. Distortion is never ignored."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liftcore.errors import InvalidCameras
from liftcore.scene.distortion import Brown, Distortion, Fisheye

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

UNDISTORT = "undistort the photos first, with 'colmap image_undistorter', and train and lift on its output"


class Intrinsics(NamedTuple):
    """A pinhole: focal lengths and principal point in pixels, from the top left corner of the image."""

    fx: float
    fy: float
    cx: float
    cy: float


class CameraModel(NamedTuple):
    """A model: its name, how many of its parameters are focal lengths, and what those behind the centre are."""

    name: str
    parameters: int
    focals: int
    distortion: tuple[str, ...] | None  # the names of the distortion's parameters; None: a model that is not read
    fisheye: bool = False


# By COLMAP's model id (src/colmap/sensor/models.h).
COLMAP_MODELS = (
    CameraModel("SIMPLE_PINHOLE", 3, 1, ()),
    CameraModel("PINHOLE", 4, 2, ()),
    CameraModel("SIMPLE_RADIAL", 4, 1, ("k1",)),
    CameraModel("RADIAL", 5, 1, ("k1", "k2")),
    CameraModel("OPENCV", 8, 2, ("k1", "k2", "p1", "p2")),
    CameraModel("OPENCV_FISHEYE", 8, 2, ("k1", "k2", "k3", "k4"), fisheye=True),
    CameraModel("FULL_OPENCV", 12, 2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    CameraModel("FOV", 5, 2, None),
    CameraModel("SIMPLE_RADIAL_FISHEYE", 4, 1, ("k1",), fisheye=True),
    CameraModel("RADIAL_FISHEYE", 5, 1, ("k1", "k2"), fisheye=True),
    CameraModel("THIN_PRISM_FISHEYE", 12, 2, None),
    CameraModel("RAD_TAN_THIN_PRISM_FISHEYE", 16, 2, None),
    CameraModel("SIMPLE_DIVISION", 4, 1, None),
    CameraModel("DIVISION", 5, 2, None),
    CameraModel("SIMPLE_FISHEYE", 3, 1, (), fisheye=True),
    CameraModel("FISHEYE", 4, 2, (), fisheye=True),
    CameraModel("EUCM", 6, 2, None),
    CameraModel("EQUIRECTANGULAR", 2, 0, None),
)
MODELS_BY_NAME = {model.name: model for model in COLMAP_MODELS}
READ_MODELS = ", ".join(model.name for model in COLMAP_MODELS if model.distortion is not None)


def calibration(model: CameraModel, parameters: Sequence[float], source: str) -> tuple[Intrinsics, Distortion | None]:
    """The intrinsics of a camera of this model, and how it is distorted; None where it is not.

    Raises:
        InvalidCameras: a parameter is missing, too many or not finite, or the model is one that is not read.
    """
    if model.distortion is None:
        raise InvalidCameras(source, expected=f"a camera of {READ_MODELS}", got=model.name, hint=UNDISTORT)
    if len(parameters) != model.parameters:
        raise InvalidCameras(
            source, expected=f"{model.parameters} parameters of {model.name}", got=str(len(parameters))
        )
    centre = model.focals + 2
    if not np.isfinite(parameters[centre:]).all():
        got = " ".join(f"{value:g}" for value in parameters[centre:])
        raise InvalidCameras(source, expected=f"finite {', '.join(model.distortion)}", got=got)
    intrinsics = Intrinsics(parameters[0], parameters[model.focals - 1], *parameters[model.focals : centre])
    named = dict(zip(model.distortion, parameters[centre:], strict=True))
    return intrinsics, distortion_of(named, fisheye=model.fisheye)


def distortion_of(named: Mapping[str, float], *, fisheye: bool) -> Distortion | None:
    """The distortion of parameters by name, those that are missing zero; None for a perspective without any."""
    if fisheye:
        return Fisheye(**named)
    return Brown(**named) if any(named.values()) else None
