"""Pictures of answers, as PNG bytes or files: masks, heat maps, renders and overlays."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from liftcore.errors import InvalidQuery
from liftcore.query.colours import cluster_colours, heat_colours, seen_colours
from liftcore.query.depth import shown_depth
from liftcore.raster.base import CompositingParams

if TYPE_CHECKING:
    from collections.abc import Mapping

    from liftcore.query.scene import QueryScene
    from liftcore.query.view_mask import ViewMask

_DIM = 0.35  # brightness that an overlay leaves to what was not found
_OUTLINE = np.array([255, 209, 64], dtype=np.uint8)  # sRGB of the line around what was found


def mask_png(look: ViewMask) -> bytes:
    """The mask, white where found, one 8-bit channel [H, W]."""
    return _png(_mask(look))


def attention_png(look: ViewMask) -> bytes:
    """The attention through the colour map, RGB [H, W, 3]; black where the ray misses the scene."""
    return _png(_heat(look))


def render_png(scene: QueryScene, view: str, what: str = "rgb") -> bytes:
    """The scene as a camera sees it, RGB [H, W, 3] on black: its colours, features (``pca``) or clusters.

    Its ``depth`` is one 8-bit channel [H, W], near bright, whose PNG tells its range as text (`ShownDepth`).

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: clusters are asked for, and the lift has none; or the image is larger than pictures may be.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    if what == "depth":
        depth = shown_depth(scene, view)
        return _png(depth.levels, depth.text())
    return _png(render(scene, view, what))


def render(scene: QueryScene, view: str, what: str = "rgb") -> np.ndarray:
    """The colours of a view, [H, W, 3] u8 sRGB on black, with the opacities as trained (gain 1).

    ``rgb`` takes the splats' own colours, ``pca`` the first three principal components of their features, and
    ``cluster`` one colour a cluster (`render_clusters`).

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: clusters are asked for, and the lift has none; or the image is larger than pictures may be.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    if what == "cluster":
        return render_clusters(scene, view)
    colours = scene.principal if what == "pca" else seen_colours(scene.splats, scene.cameras[view])
    walk = CompositingParams(antialiased=scene.walk.antialiased)
    image = scene.image(view, lambda camera: scene.raster.render(camera, colours, walk))
    levels = image.numpy()  # in place: an image of floats is large
    np.clip(levels, 0.0, 1.0, out=levels)
    levels *= 255
    return np.round(levels, out=levels).astype(np.uint8)


def render_clusters(scene: QueryScene, view: str) -> np.ndarray:
    """The cluster of the most weight on each ray, [H, W, 3] u8: as aggregation saw it, with the rendering gain.

    Grey where unclustered splats have the most, black where the ray misses the scene.

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: the lift has no clusters, or the view's image is larger than pictures may be.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    clusters, means = scene.lift.cluster, scene.lift.cluster_features
    if clusters is None or means is None:
        hint = "lift again with the setting aggregation=true"
        raise InvalidQuery("what", expected="a lift with clusters", got="a lift without aggregation", hint=hint)
    labels = scene.image(view, lambda camera: scene.raster.strongest_labels(camera, clusters, scene.walk))
    picture = cluster_colours(means.shape[0])[labels.numpy()]  # the last colour is that of label -1
    sums = scene.image(view, lambda camera: scene.raster.row_sums(camera, scene.walk))
    picture[sums.numpy() <= 0] = 0
    return picture


def _mask(look: ViewMask) -> np.ndarray:
    return look.mask.numpy().astype(np.uint8) * 255


def _heat(look: ViewMask) -> np.ndarray:
    return heat_colours(look.attention.numpy(), look.row_sums.numpy() > 0)


def overlay(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[H, W, 3] u8: an image with a mask [H, W] bool bright and outlined, and the rest dimmed."""
    picture = np.where(mask[..., None], image, (_DIM * image).astype(np.uint8))
    picture[_border(mask)] = _OUTLINE
    return picture


def _border(mask: np.ndarray) -> np.ndarray:
    """Pixels outside a mask that touch it, sideways or diagonally."""
    padded = np.pad(mask, 1)
    height, width = mask.shape
    near = np.zeros_like(mask)
    for dy in range(3):
        for dx in range(3):
            near |= padded[dy : dy + height, dx : dx + width]
    return near & ~mask


def _png(pixels: np.ndarray, text: Mapping[str, str] | None = None) -> bytes:
    """A picture [H, W] or [H, W, 3] u8 with text chunks."""
    buffer, chunks = io.BytesIO(), PngInfo()
    for name, value in (text or {}).items():
        chunks.add_text(name, value)
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, format="PNG", pnginfo=chunks)
    return buffer.getvalue()
