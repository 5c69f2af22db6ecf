"""What the products of every backend ask of their arguments, in one set of words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.errors import InvalidInput

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.scene.cameras import Camera


def check_rows(values: Tensor, splats: int) -> None:
    """See that values are [P, C].

    Raises:
        InvalidInput: they are not.
    """
    if values.ndim != 2 or values.shape[0] != splats:
        raise InvalidInput("values", expected=f"one row for each of {splats} splats", got=f"{list(values.shape)}")


def check_image(values: Tensor, camera: Camera) -> None:
    """See that values are [H, W, C].

    Raises:
        InvalidInput: they are not.
    """
    if values.ndim != 3 or values.shape[:2] != (camera.height, camera.width):
        expected = f"an image of {camera.height} rows of {camera.width} pixels"
        raise InvalidInput("values", expected=expected, got=f"{list(values.shape)}")


def check_labels(labels: Tensor, splats: int) -> None:
    """See that labels are [P] and -1 or more.

    Raises:
        InvalidInput: they are not.
    """
    if labels.ndim != 1 or labels.shape[0] != splats or int(labels.min()) < -1:
        got = f"{list(labels.shape)}, the smallest {int(labels.min())}"
        raise InvalidInput("labels", expected=f"a label of -1 or more for each of {splats} splats", got=got)
