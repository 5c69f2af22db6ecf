"""What counts of a ray's weights, written plainly: the float64 reference of every selection.

Each rule is the sentence that defines it, over the dense A with its columns in depth order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.raster.base import CompositingParams, Selection, Weighting

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

EDGE_BAND = 1e-4  # relative on weights, pixels on centres: nearer to a decision, float32 may decide otherwise


def counted_weights(
    A: np.ndarray, splats: Splats, camera: Camera, walk: CompositingParams, weighting: Weighting
) -> tuple[np.ndarray, np.ndarray]:
    """A' [H * W, P], the weights of A [H * W, P] that count, to their power; and the rays [H * W] hard to decide."""
    depths = splats.means.double().numpy() @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    order = np.argsort(depths.astype(np.float32), kind="stable")
    w = A[:, order]  # near to far
    if weighting.selection is Selection.TOP_K:
        counts, cut = _largest(w, weighting.count)
    elif weighting.selection is Selection.FRONT_MASS:
        taken = np.cumsum(w, axis=1) - w  # 1 - T before the splat
        counts = taken < weighting.mass
        cut = ((np.abs(taken - weighting.mass) < EDGE_BAND) & (w > 0)).any(axis=1)
    elif weighting.selection is Selection.CENTRE:
        counts, cut = (part[:, order] for part in _centres(A, splats, camera, walk))
        cut = cut.any(axis=1)
    else:
        counts, cut = np.ones_like(w, bool), np.zeros(w.shape[0], bool)
    counts &= (w > 0) & (w >= weighting.floor)
    cut = cut | (np.abs(w - weighting.floor) < EDGE_BAND * weighting.floor).any(axis=1)
    chosen = np.zeros_like(A)
    chosen[:, order] = np.where(counts, w**weighting.power, 0.0)
    return chosen, np.asarray(cut)


def walked_rays(camera: Camera, walk: CompositingParams) -> np.ndarray:
    """[H * W] bool, the rays that the walk's stride leaves."""
    y, x = np.mgrid[: camera.height, : camera.width]
    left, top = walk.offset
    return (((x - left) % walk.stride == 0) & ((y - top) % walk.stride == 0)).ravel()


def _largest(w: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The k largest of every row, of equal ones the first; and the rows whose k-th and next are too close to call."""
    order = np.argsort(-w, axis=1, kind="stable")
    counts = np.zeros_like(w, bool)
    np.put_along_axis(counts, order[:, :k], values=True, axis=1)
    if w.shape[1] <= k:
        return counts, np.zeros(w.shape[0], bool)
    last, following = (np.take_along_axis(w, order[:, [at]], axis=1)[:, 0] for at in (k - 1, k))
    return counts, (following > 0) & (last - following < EDGE_BAND * last)


def _centres(A: np.ndarray, splats: Splats, camera: Camera, walk: CompositingParams) -> tuple[np.ndarray, np.ndarray]:
    """[H * W, P] bool: the walked ray nearest to the splat's projected centre; and rays of centres near a border."""
    counts, cut = np.zeros_like(A, bool), np.zeros_like(A, bool)
    pose = camera.viewmat
    for j, mean in enumerate(splats.means.double().numpy()):
        x, y, z = pose[:3, :3] @ mean + pose[:3, 3]
        if z <= 0:
            continue
        centre = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        steps = (centre - 0.5 - np.array(walk.offset)) / walk.stride + 0.5  # whole numbers at the cells' borders
        column, row = np.floor(steps).astype(int) * walk.stride + np.array(walk.offset)
        if 0 <= column < camera.width and 0 <= row < camera.height:
            counts[row * camera.width + column, j] = True
        if (np.abs(steps - np.round(steps)) < EDGE_BAND).any():
            cut[:, j] = A[:, j] > 0
    return counts, cut
