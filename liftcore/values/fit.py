"""The fit of a dense map to its photo: what the encoder's preprocessing made of the photo.

| fit | the photo became | the map shows |
|---|---|---|
| `stretch` | its sides were scaled to those of the map, each by itself | the whole photo |
| `pad` | the whole photo was scaled, with bars on both sides | the whole photo, and bars |
| `pad-end` | the same, with bars at the right or the bottom, as in SAM | the whole photo, and bars |
| `crop` | its centre was cut out, as CLIP's preprocessing does | the centre |

A map of another fit than `stretch` is read by the camera of the part of the photo that its cells show: cells of bars
are cut off with the rest of a cell that they share with the photo, and rays beside a crop have no feature.
"""

import math
from typing import Literal, NamedTuple, get_args

from liftcore.errors import InvalidFeatures
from liftcore.scene.cameras import Camera

Fit = Literal["stretch", "pad", "pad-end", "crop"]
FITS: tuple[Fit, ...] = get_args(Fit)
ROUNDING = 1e-6  # of a cell


class Window(NamedTuple):
    """The cells of a map that show a part of its photo, and that part in pixels."""

    rows: slice
    columns: slice
    left: float
    top: float
    right: float
    bottom: float


def window_of(fit: str, cells: tuple[int, int], photo: tuple[int, int]) -> Window | None:
    """Return what a map of that fit shows of its photo; None of one that covers it whole.

    Args:
        fit: of the map; "" for not recorded, which is read as ``stretch``. cells, photo: width and height of each.
    """
    if fit in ("", "stretch"):
        return None
    fits = min if fit == "crop" else max
    pixels = fits(photo[0] / cells[0], photo[1] / cells[1])  # of a cell's side
    spans = [
        _span(count, side, pixels, 0.0 if fit == "pad-end" else 0.5) for count, side in zip(cells, photo, strict=True)
    ]
    (columns, left, right), (rows, top, bottom) = spans
    return Window(rows, columns, left, top, right, bottom)


def _span(cells: int, side: int, pixels: float, before: float) -> tuple[slice, float, float]:
    """Return the cells of an axis that lie within the photo, and the first and last pixels' edges under them."""
    # Of the first cell, in pixels of the photo; a share of a bar, or of what was cut off, lies before it.
    start = before * (side - cells * pixels)
    first, last = math.ceil(-start / pixels - ROUNDING), math.floor((side - start) / pixels + ROUNDING)
    first, last = max(first, 0), min(last, cells)
    return slice(first, last), start + first * pixels, start + last * pixels


def camera_of(window: Window | None, camera: Camera) -> Camera:
    """Return the camera of the part of a photo that a map shows, its focal lengths to the nearest whole pixel."""
    if window is None:
        return camera
    if camera.lens is not None:
        expected, hint = (
            "maps of the fit stretch for distorted photos",
            "undistort the photos before they are encoded",
        )
        raise InvalidFeatures(f"view {camera.name!r}", expected=expected, got="pad or crop", hint=hint)
    sides = window.right - window.left, window.bottom - window.top
    if min(sides) < 1:
        expected, got = "a map with whole cells in the photo", f"none in {camera.width} x {camera.height} pixels"
        hint = "say another fit of the maps, or encode the photos in smaller cells"
        raise InvalidFeatures(f"view {camera.name!r}", expected=expected, got=got, hint=hint)
    width, height = map(round, sides)
    across, down = width / sides[0], height / sides[1]
    return camera.replace(
        width=width, height=height, fx=camera.fx * across, fy=camera.fy * down,
        cx=(camera.cx - window.left) * across, cy=(camera.cy - window.top) * down,
    )  # fmt: skip
