"""From the camera models of COLMAP to a pinhole, or a refusal: distortion is never ignored."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from liftcore.errors import InvalidCameras

if TYPE_CHECKING:
    from collections.abc import Sequence

UNDISTORT = "undistort the photos first, with 'colmap image_undistorter', and train and lift on its output"


class Intrinsics(NamedTuple):
    """A pinhole: focal lengths and principal point in pixels, from the top left corner of the image."""

    fx: float
    fy: float
    cx: float
    cy: float


class CameraModel(NamedTuple):
    """A model: its name, its number of parameters, how many of them are focal lengths, what it can be."""

    name: str
    parameters: int
    focals: int
    perspective: bool  # a pinhole when every parameter behind the principal point is zero


# By COLMAP's model id (src/colmap/sensor/models.h).
COLMAP_MODELS = (
    CameraModel("SIMPLE_PINHOLE", 3, 1, True),
    CameraModel("PINHOLE", 4, 2, True),
    CameraModel("SIMPLE_RADIAL", 4, 1, True),
    CameraModel("RADIAL", 5, 1, True),
    CameraModel("OPENCV", 8, 2, True),
    CameraModel("OPENCV_FISHEYE", 8, 2, False),
    CameraModel("FULL_OPENCV", 12, 2, True),
    CameraModel("FOV", 5, 2, False),
    CameraModel("SIMPLE_RADIAL_FISHEYE", 4, 1, False),
    CameraModel("RADIAL_FISHEYE", 5, 1, False),
    CameraModel("THIN_PRISM_FISHEYE", 12, 2, False),
    CameraModel("RAD_TAN_THIN_PRISM_FISHEYE", 16, 2, False),
)
MODELS_BY_NAME = {model.name: model for model in COLMAP_MODELS}


def pinhole(model: CameraModel, parameters: Sequence[float], source: str) -> Intrinsics:
    """The pinhole that a camera of this model is.

    Raises:
        InvalidCameras: the model has another number of parameters, or the camera is distorted.
    """
    if len(parameters) != model.parameters:
        raise InvalidCameras(
            source, expected=f"{model.parameters} parameters of {model.name}", got=str(len(parameters))
        )
    if not model.perspective:
        raise InvalidCameras(source, expected="a perspective camera", got=model.name, hint=UNDISTORT)
    distortion = parameters[model.focals + 2 :]
    if any(value != 0 for value in distortion):
        values = ", ".join(f"{value:g}" for value in distortion)
        got = f"{model.name} with distortion {values}"
        raise InvalidCameras(source, expected="a camera without distortion", got=got, hint=UNDISTORT)
    cx, cy = parameters[model.focals : model.focals + 2]
    return Intrinsics(parameters[0], parameters[model.focals - 1], cx, cy)
