"""The feature that an area of a camera's image shows: of a pixel, a box or a stroke.

A pixel shows ``sum_j A_ij x_j``. Of a box or a stroke evenly chosen pixels are taken. A box around a thing holds some
of what is behind it, and so does the band around the box, of about the same area: a pixel i of the box counts by
``w_i = (1 - r_i)^2``, where r_i is its cosine to the pixels of the band, but for the nearest REACH of them. Pixels of
a stroke count alike. The feature is ``sum_k w_k u_k`` of the unit features u_k that are like that of the pixel i for
which ``sum_k w_k cos(u_i, u_k)`` is largest: what else is in the area does not count. Cosines are those of examples,
as seen from the scene's mean.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidQuery, NotFound
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.scores import LEAST_LIKENESS, cosines_about, norms_of
from liftcore.query.terms import AREAS, NOTATIONS, Area, Pixel, PixelBox, Stroke

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera

MINIMUM_ROW_SUM = 0.5  # below it a ray mostly misses the scene: no histogram, no mask and no example takes it
AREA_PIXELS = 256  # of an area that are looked at
BAND = 0.2  # of a box's side, on each side of it: 1.4 x 1.4 is twice the area
REACH = 0.15  # of the band, into which the thing may reach out of a box that is drawn too small


def feature_shown(scene: OpenedLift, area: Area) -> np.ndarray:
    """What a camera of the scene shows in an area of its image, [F] f64; of a pixel as scores are rendered.

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: the area is empty, reaches out of the image, lies at the rim of a wide lens, or shows no scene;
            or a box or a stroke lacks corners.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    camera = _camera(scene, area)
    inside, around = _pixels(area, *camera.photo_size)
    rows = _rendered(scene, camera, area, inside)
    if len(rows) == 1:
        return rows[0]
    return _common(scene, rows, _rendered(scene, camera, None, around))


def _camera(scene: OpenedLift, area: Area) -> Camera:
    """The camera of an area. Where no view is named "VIEW:box", `VIEW:box:x,y` is a box without all its corners."""
    try:
        return scene.cameras[area.view]
    except NotFound:
        if isinstance(area, Pixel) and area.view.endswith(AREAS):
            raise InvalidQuery(str(area), expected=NOTATIONS, got="two numbers", hint="give all corners") from None
        raise


def _pixels(area: Area, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """[n, 2] and [m, 2] i64 (x, y), pixels of an area and of the band around it."""
    none = np.zeros((0, 2), np.int64)
    if isinstance(area, PixelBox):
        if not (0 <= area.x0 < area.x1 <= width and 0 <= area.y0 < area.y1 <= height):
            expected = f"0 <= x0 < x1 <= {width} and 0 <= y0 < y1 <= {height}"
            got = f"{area.x0},{area.y0},{area.x1},{area.y1}"
            raise InvalidQuery(str(area), expected=expected, got=got, hint="give the upper left corner first")
        band = [math.ceil(BAND * side) for side in (area.x1 - area.x0, area.y1 - area.y0)]
        left, top = max(0, area.x0 - band[0]), max(0, area.y0 - band[1])
        right, bottom = min(width, area.x1 + band[0]), min(height, area.y1 + band[1])
        near = _grid(left, top, right, bottom, 2 * AREA_PIXELS)
        is_inside = ((near >= (area.x0, area.y0)) & (near < (area.x1, area.y1))).all(axis=1)
        return _grid(area.x0, area.y0, area.x1, area.y1, AREA_PIXELS), near[~is_inside]
    corners = np.array([(area.x, area.y)] if isinstance(area, Pixel) else area.pixels)
    if not ((corners >= 0) & (corners < (width, height))).all():
        x, y = next((x, y) for x, y in corners.tolist() if not (0 <= x < width and 0 <= y < height))
        expected = f"x in 0..{width - 1} and y in 0..{height - 1}"
        raise InvalidQuery(str(area), expected=expected, got=f"{x},{y}")
    return (_line(corners) if isinstance(area, Stroke) else corners), none


def _grid(left: int, top: int, right: int, bottom: int, most: int) -> np.ndarray:
    """[n, 2] i64, evenly spaced pixels of a box, about as far apart across as down."""
    width, height = right - left, bottom - top
    across = min(width, most, max(1, round(math.sqrt(most * width / height))))
    down = min(height, max(1, most // across))
    columns = left + (np.arange(across) * 2 + 1) * width // (2 * across)
    rows = top + (np.arange(down) * 2 + 1) * height // (2 * down)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _line(corners: np.ndarray) -> np.ndarray:
    """[n, 2] i64, evenly spaced pixels, each once, of the line through corners [k, 2]."""
    lengths = np.append(0, np.abs(np.diff(corners, axis=0)).max(axis=1).cumsum())
    steps = np.linspace(0, lengths[-1], min(int(lengths[-1]) + 1, AREA_PIXELS))
    pixels = np.rint([np.interp(steps, lengths, axis) for axis in corners.T]).astype(np.int64)
    return np.unique(pixels, axis=1).T


def _rendered(scene: OpenedLift, camera: Camera, area: Area | None, pixels: np.ndarray) -> np.ndarray:
    """``sum_j A_ij x_j`` of the rays of pixels [n, 2] that meet the scene, [m, F] f64.

    Args:
        area: whose pixels these are; where none of them meets the scene it is to blame. None: there may be none.
    """
    rays = _rays(scene, camera, area, pixels)
    features = [weights.astype(np.float64) @ scene.features[splats].astype(np.float64) for splats, weights in rays]
    return np.stack(features) if features else np.zeros((0, scene.channels))


def splats_shown(scene: OpenedLift, area: Area) -> tuple[np.ndarray, np.ndarray]:
    """The splats on the rays of an area's pixels, [n] i32, and their weights there, [n] f32; some several times.

    Raises:
        NotFound, InvalidQuery, InvalidLift: as `feature_shown`.
    """
    camera = _camera(scene, area)
    rays = _rays(scene, camera, area, _pixels(area, *camera.photo_size)[0])
    splats, weights = zip(*rays, strict=True)
    return np.concatenate(splats), np.concatenate(weights)


def _rays(
    scene: OpenedLift, camera: Camera, area: Area | None, pixels: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The splats and their weights on each of the rays of `_rendered`, whose arguments these are."""
    import torch

    from liftcore.scene.cameras import drawn_by, pixel_of

    what = "a pixel" if isinstance(area, Pixel) else "an area"
    drawn = [place for x, y in pixels.tolist() if (place := pixel_of(camera, x, y)) is not None]
    if not drawn:
        if area is None:
            return []
        hint, got = "pick one nearer to the middle", "one at the rim of a wide lens"
        raise InvalidQuery(str(area), expected=f"{what} that a pinhole sees", got=got, hint=hint)
    found = scene.raster.ray_rows(drawn_by(camera), torch.tensor(drawn, dtype=torch.int32), scene.compositing)
    ends, splats, weights = map(as_numpy, (found.indptr, found.splats, found.weights))
    rays = [slice(first, last) for first, last in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]
    met = [float(weights[ray].sum()) for ray in rays]
    if area is not None and max(met) < MINIMUM_ROW_SUM:
        got = f"{'a ray' if len(rays) == 1 else 'rays'} that splats fill by {max(met):.1%}"
        raise InvalidQuery(str(area), expected=f"{what} that shows the scene", got=got, hint="pick one on a surface")
    return [(splats[ray], weights[ray]) for ray, share in zip(rays, met, strict=True) if share >= MINIMUM_ROW_SUM]


def _common(scene: OpenedLift, rows: np.ndarray, around: np.ndarray) -> np.ndarray:
    """[F] f64, the common feature of those [n, F] of an area, which is not that of those [m, F] around it."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    units = (rows / np.maximum(lengths, np.finfo(np.float64).tiny)).astype(np.float32)
    everywhere = np.concatenate([rows, around]).astype(np.float32)
    alike = cosines_about(everywhere, norms_of(everywhere), scene.mean, units)  # [n + m, n], as an example scores
    among, weights = alike[: len(rows)], np.ones(len(rows))
    if len(around):
        weights = (1 - np.quantile(alike[len(rows) :], 1 - REACH, axis=0)) ** 2
    likeness = (weights[:, None] * among).sum(axis=0)
    chosen = int(np.argmax(np.where(lengths[:, 0] > 0, likeness, -np.inf)))
    like = among[:, chosen] >= min(LEAST_LIKENESS, among[chosen, chosen])
    return ((weights if weights[like].any() else np.ones(len(rows))) * like) @ units.astype(np.float64)
