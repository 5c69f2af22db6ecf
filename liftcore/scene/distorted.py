"""Distorted cameras beside undistorted ones of the same photos: which of the two is meant cannot be guessed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.errors import InvalidCameras
from liftcore.io.colmap import read_colmap
from liftcore.scene.lens import lifted_share

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from liftcore.scene.cameras import Camera

_NEARLY_ALL = 0.995  # a share that would be told as 100%


def is_undistorted(model: Path) -> bool:
    """Whether a folder has a model that reads, of pinholes alone."""
    try:
        return not read_colmap(model).distorted
    except InvalidCameras:
        return False


def refuse_both(source: str, read: str, undistorted: Sequence[str], choose: str) -> None:
    """Refuse distorted cameras where undistorted ones lie beside them.

    Args:
        source: what holds both. read: the distorted model. undistorted: the others. choose: how one of them is.

    Raises:
        InvalidCameras: there are others.
    """
    if undistorted:
        raise InvalidCameras(
            source,
            expected="distorted or undistorted cameras, not both",
            got=f"distorted ones in {read} and undistorted ones in {undistorted[0]}",
            hint=f"{choose} whose photos the features were made of",
        )


def distortion_warning(views: Sequence[Camera]) -> list[str]:
    """What is to be said of distorted views, if there are some."""
    shares = [lifted_share(camera) for camera in views if camera.lens is not None]
    if not shares:
        return []
    least = min(shares)
    lifted = "nearly all" if least > _NEARLY_ALL else f"{least:.0%} or more"
    return [
        f"{len(shares)} of {len(views)} views are of distorted photos, of each of which {lifted} is "
        "lifted: features must be of the photos as they were taken, not of undistorted ones"
    ]
