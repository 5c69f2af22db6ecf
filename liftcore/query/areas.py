"""The feature of an area of a camera's image: a pixel, a box or a stroke.

A pixel has the feature ``sum_j A_ij x_j``. A box or a stroke is sampled by evenly spaced pixels. A box around an
object also contains background, as does the band around the box, of about the same area. So a pixel i of the box has
the weight ``w_i = (1 - r_i)^2``, where r_i is its cosine to the pixels of the band without the nearest REACH of them.
All pixels of a stroke have the same weight. The feature is ``sum_k w_k u_k`` over the unit features u_k similar to
that of the pixel i with the largest ``sum_k w_k cos(u_i, u_k)``: all else in the area is left out. Cosines are taken
about the scene's mean, as for examples.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.scene import Scene, as_numpy
from liftcore.query.scores import LEAST_LIKENESS, cosines_about, norms_of
from liftcore.query.terms import Area

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera

MINIMUM_ROW_SUM = 0.5  # below it a ray mostly misses the scene: histograms, masks and examples leave it out
AREA_PIXELS = 256  # most pixels that sample an area
BAND = 0.2  # of a box's side, on each side of it: 1.4 x 1.4 is twice the area
REACH = 0.15  # of the band, into which the object may extend if the box is drawn too small


def area_feature(scene: Scene, area: Area) -> np.ndarray:
    """Return the feature of an area of a camera's image, [F] f64; of a pixel as scores are rendered.

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: the area is empty, outside the image, at the rim of a wide lens, or misses the scene;
            or a box or a stroke lacks corners.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    camera = scene.cameras[area.view]
    inside, around = _pixels(area, *camera.photo_size)
    rows = _rendered(scene, camera, area, inside)
    if len(rows) == 1:
        return rows[0]
    return _common(scene, rows, _rendered(scene, camera, None, around))


def _pixels(area: Area, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels of an area and of the band around it, [n, 2] and [m, 2] i64 (x, y)."""
    none = np.zeros((0, 2), np.int64)
    corners = np.array(area.corners)
    if area.kind == "box":
        (x0, y0), (x1, y1) = area.corners
        if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
            expected = f"0 <= x0 < x1 <= {width} and 0 <= y0 < y1 <= {height}"
            hint = "give the upper left corner first"
            raise InvalidQuery(str(area), expected=expected, got=f"{x0},{y0},{x1},{y1}", hint=hint)
        band = np.ceil(BAND * (corners[1] - corners[0])).astype(np.int64)
        left, top = np.maximum(corners[0] - band, 0).tolist()
        right, bottom = np.minimum(corners[1] + band, (width, height)).tolist()
        near = _grid(left, top, right, bottom, 2 * AREA_PIXELS)
        is_inside = ((near >= corners[0]) & (near < corners[1])).all(axis=1)
        return _grid(x0, y0, x1, y1, AREA_PIXELS), near[~is_inside]
    if not ((corners >= 0) & (corners < (width, height))).all():
        x, y = next((x, y) for x, y in corners.tolist() if not (0 <= x < width and 0 <= y < height))
        expected = f"x in 0..{width - 1} and y in 0..{height - 1}"
        raise InvalidQuery(str(area), expected=expected, got=f"{x},{y}")
    return (_line(corners) if area.kind == "stroke" else corners), none


def _grid(left: int, top: int, right: int, bottom: int, limit: int) -> np.ndarray:
    """Return at most ``limit`` evenly spaced pixels of a box, [n, 2] i64, with about equal spacing in x and y."""
    width, height = right - left, bottom - top
    across = min(width, limit, max(1, round(math.sqrt(limit * width / height))))
    down = min(height, max(1, limit // across))
    columns = left + (np.arange(across) * 2 + 1) * width // (2 * across)
    rows = top + (np.arange(down) * 2 + 1) * height // (2 * down)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _line(corners: np.ndarray) -> np.ndarray:
    """Return evenly spaced pixels of the line through corners [k, 2], each once, [n, 2] i64."""
    lengths = np.append(0, np.abs(np.diff(corners, axis=0)).max(axis=1).cumsum())
    steps = np.linspace(0, lengths[-1], min(int(lengths[-1]) + 1, AREA_PIXELS))
    pixels = np.rint([np.interp(steps, lengths, axis) for axis in corners.T]).astype(np.int64)
    return np.unique(pixels, axis=1).T


def _rendered(scene: Scene, camera: Camera, area: Area | None, pixels: np.ndarray) -> np.ndarray:
    """Compute ``sum_j A_ij x_j`` of the rays of pixels [n, 2] that hit the scene, [m, F] f64.

    Args:
        area: of these pixels, named in the error if none hits the scene. None: that is no error.
    """
    rays = _rays(scene, camera, area, pixels)
    features = [weights.astype(np.float64) @ scene.features[splats].astype(np.float64) for splats, weights in rays]
    return np.stack(features) if features else np.zeros((0, scene.channels))


def area_splats(scene: Scene, area: Area) -> tuple[np.ndarray, np.ndarray]:
    """Return the splats on the rays of an area's pixels, [n] i32 with repeats, and their weights there, [n] f32."""
    camera = scene.cameras[area.view]
    rays = _rays(scene, camera, area, _pixels(area, *camera.photo_size)[0])
    splats, weights = zip(*rays, strict=True)
    return np.concatenate(splats), np.concatenate(weights)


def _rays(scene: Scene, camera: Camera, area: Area | None, pixels: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the splats and their weights on each ray that hits the scene; arguments as of `_rendered`."""
    import torch

    from liftcore.scene.cameras import drawn_by, pixel_of

    pinhole_pixels = [place for x, y in pixels.tolist() if (place := pixel_of(camera, x, y)) is not None]
    rays, got = list[tuple[np.ndarray, np.ndarray]](), "one at the rim of a wide lens"
    if pinhole_pixels:
        pinhole, places = drawn_by(camera), torch.tensor(pinhole_pixels, dtype=torch.int32)
        ray_rows = scene.raster.ray_rows(pinhole, places, scene.compositing)
        ends, splats, weights = map(as_numpy, (ray_rows.indptr, ray_rows.splats, ray_rows.weights))
        rays = [(splats[first:last], weights[first:last]) for first, last in pairwise(ends.tolist())]
        row_sums = [float(on_ray.sum()) for _, on_ray in rays]
        rays = [ray for ray, row_sum in zip(rays, row_sums, strict=True) if row_sum >= MINIMUM_ROW_SUM]
        got = f"{'a ray' if len(row_sums) == 1 else 'rays'} with an opacity of {max(row_sums):.1%}"
    if area is not None and not rays:
        noun = "a pixel" if area.kind == "pixel" else "an area"
        raise InvalidQuery(str(area), expected=f"{noun} that shows the scene", got=got, hint="pick one on a surface")
    return rays


def _common(scene: Scene, rows: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Return the common feature [F] f64 of the pixels [n, F] of an area, other than that of the band [m, F]."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    units = (rows / np.maximum(lengths, np.finfo(np.float64).tiny)).astype(np.float32)
    everywhere = np.concatenate([rows, around]).astype(np.float32)
    similarities = cosines_about(
        everywhere, norms_of(everywhere), scene.mean, units
    )  # [n + m, n], as an example scores
    among, weights = similarities[: len(rows)], np.ones(len(rows))
    if len(around):
        weights = (1 - np.quantile(similarities[len(rows) :], 1 - REACH, axis=0)) ** 2
    likeness = (weights[:, None] * among).sum(axis=0)
    best = int(np.argmax(np.where(lengths[:, 0] > 0, likeness, -np.inf)))
    like = among[:, best] >= min(LEAST_LIKENESS, among[best, best])
    return ((weights if weights[like].any() else np.ones(len(rows))) * like) @ units.astype(np.float64)
