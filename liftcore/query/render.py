"""A scene and its answers seen from a camera: masks, attention, colours and depths, in the pixels of the photo."""

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from liftcore.errors import InvalidQuery
from liftcore.query.areas import MINIMUM_ROW_SUM
from liftcore.query.colours import cluster_colours, heat_colours, map_colours
from liftcore.query.objects import objects
from liftcore.query.opened import OpenedLift
from liftcore.query.question import Answer, Objects
from liftcore.query.splat_colours import view_colours
from liftcore.runtime.one_line import one_line, value_text
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams

LEAST_SHARE = 0.5  # of a ray's weight, that what was found must have in a mask
MOST_GROUPED = 1 << 17  # selected splats whose strays a mask leaves out: they take .4 s of two cores
_SHOWN = (0.01, 0.99)  # quantiles of the covered pixels' depths: a floater before the lens dims no picture
_LEVELS = 254  # between the farthest covered pixel, at 1, and the nearest, at 255; 0 is for what no splat covers
_DIM = 0.35  # brightness that an overlay leaves to what was not found
_TINT = 0.25  # of the outline's colour, in what was found
_OUTLINE = np.array([255, 209, 64], dtype=np.uint8)  # sRGB of the line around what was found


@dataclass(frozen=True)
class ViewMask:
    """An answer seen from one camera."""

    view: str
    """the name of its camera"""
    attention: np.ndarray
    """[H, W] f32, A s: scores rendered with the lift's scale of opacity; 0 of an absent thing"""
    row_sums: np.ndarray
    """[H, W] f32, A 1"""
    mask: np.ndarray
    """[H, W] bool, where at least half of a ray that meets the scene is of what was found"""
    explanation: str
    """one sentence on what the mask shows"""

    def __repr__(self) -> str:
        size = f"{list(self.mask.shape)} pixels, {self.mask.mean():.1%} of them in the mask"
        return one_line(self, value_text(self.view), size, value_text(self.explanation))

    @staticmethod
    def overlay(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """[H, W, 3] u8: an image [H, W, 3] u8 with a mask [H, W] bool tinted and outlined, and the rest dimmed."""
        return overlay(image, mask)


@dataclass(frozen=True)
class ShownDepth:
    """Depths as a grey picture: a level of 1 is ``far`` or farther, 255 ``near`` or nearer, and 0 no depth."""

    levels: np.ndarray  # [H, W] u8
    span: tuple[float, float] | None  # near and far, scene units; None when no pixel is covered

    def text(self) -> dict[str, str]:
        """What a PNG of it says of itself: ``depth-near`` and ``depth-far``, in decimals that read back exactly."""
        return {} if self.span is None else dict(zip(("depth-near", "depth-far"), map(repr, self.span), strict=True))


def view_mask(
    scene: OpenedLift, answer: Answer, view: str | Camera, group: Callable[[OpenedLift, Answer], Objects] = objects
) -> ViewMask:
    """See an answer from a camera: attention, and a mask of the objects that were found.

    The mask is ``A m >= A 1 / 2``, with m = 1 for the splats of the answer's objects: what was found in the scene,
    where nothing hides it. It has no threshold of its own, so a view that does not see it has an empty mask. Of more
    than 131,072 selected splats strays are not told apart, unless the query keeps some of the objects.

    Args:
        scene: the opened lift. answer: of that lift.
        view: the name of a camera, lifted or not; or any camera in the frame of the splats.
        group: makes the objects of an answer; who has them already gives them so.

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: the view's image is larger than pictures may be; or the largest of more splats than are grouped.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    camera = scene.camera(view)  # a name that is not there is told before anything is grouped
    if answer.count > MOST_GROUPED and not answer.query.keeps_some:
        members, shown = answer.selected, f"all {answer.count} selected splats, too many to tell strays apart"
    else:
        found = group(scene, answer)
        members, count = found.numbers >= 0, len(found.found)
        shown = f"the {count} object{'s' * (count != 1)} that {'were' if count != 1 else 'was'} found"
    # A splat without a feature adds nothing to a ray; its score of -1 would count against its neighbours.
    scores = np.where(answer.seen & (not answer.dropped), answer.scores, np.float32(0.0))
    values = torch.from_numpy(np.stack([scores, members.astype(np.float32), np.ones_like(scores)], axis=1))
    image = scene.image(camera, lambda of: scene.raster.render(of, values, scene.compositing)).numpy()
    attention, weights, row_sums = (np.ascontiguousarray(image[..., column]) for column in range(3))
    mask = (row_sums >= MINIMUM_ROW_SUM) & (weights >= LEAST_SHARE * row_sums)
    return ViewMask(camera.name, attention, row_sums, mask, f"at least half of the ray is of {shown}")


def mask_png(mask: np.ndarray) -> bytes:
    """A mask [H, W] bool as one 8-bit channel, white where it is."""
    return _png(mask.astype(np.uint8) * 255)


def attention_png(seen: ViewMask) -> bytes:
    """The attention through the colour map, RGB [H, W, 3]; black where the ray misses the scene."""
    return _png(heat_colours(seen.attention, seen.row_sums > 0))


def render_png(scene: OpenedLift, view: str | Camera, what: str = "rgb") -> bytes:
    """The scene as a camera sees it, RGB [H, W, 3] on black: its colours, features (``pca``) or clusters.

    Its ``depth`` is one 8-bit channel [H, W], near bright, whose PNG tells its range as text (`ShownDepth`).

    Raises:
        NotFound, InvalidQuery, InvalidLift: as `render` does.
    """
    if what == "depth":
        depth = shown_depth(scene, view)
        return _png(depth.levels, depth.text())
    return _png(render(scene, view, what))


def render(scene: OpenedLift, view: str | Camera, what: str = "rgb") -> np.ndarray:
    """The colours of a view, [H, W, 3] u8 sRGB on black, with the opacities as trained.

    ``rgb`` takes the splats' own colours, ``pca`` the first three principal components of their features, and
    ``cluster`` one colour a cluster: that of the most weight on each ray, as aggregation saw it. There, grey is where
    unclustered splats have the most. ``confidence`` is the mean of the splats' on each ray through the colour map of
    scores, which spans it from 0 to 1.

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: clusters or confidence are asked for, and the lift has none; or the image is larger than
            pictures may be.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    if what == "cluster":
        return _render_clusters(scene, view)
    if what == "confidence":
        return _render_confidence(scene, view)
    colours = scene.principal if what == "pca" else view_colours(scene.splats, scene.camera(view))
    levels = scene.image(view, lambda camera: scene.raster.render(camera, colours, _as_trained(scene))).numpy()
    np.clip(levels, 0.0, 1.0, out=levels)  # in place: an image of floats is large
    levels *= 255
    return np.round(levels, out=levels).astype(np.uint8)


def _render_clusters(scene: OpenedLift, view: str | Camera) -> np.ndarray:
    if scene.cluster is None or scene.cluster_features is None:
        hint = "lift again with the setting aggregation=true"
        raise InvalidQuery("what", expected="a lift with clusters", got="a lift without aggregation", hint=hint)
    clusters = torch.from_numpy(scene.cluster)
    labels = scene.image(view, lambda camera: scene.raster.strongest_labels(camera, clusters, scene.compositing))
    picture = cluster_colours(len(scene.cluster_features))[labels.numpy()]  # the last colour is that of label -1
    sums = scene.image(view, lambda camera: scene.raster.row_sums(camera, scene.compositing))
    picture[sums.numpy() <= 0] = 0
    return picture


def _render_confidence(scene: OpenedLift, view: str | Camera) -> np.ndarray:
    if scene.confidence is None:
        hint = "lift again with the preset default, or with robust_steps"
        raise InvalidQuery("what", expected="a lift with confidence", got="a lift that was not reweighted", hint=hint)
    values = torch.from_numpy(np.stack([scene.confidence, np.ones_like(scene.confidence)], axis=1))
    image = scene.image(view, lambda camera: scene.raster.render(camera, values, scene.compositing)).numpy()
    sums = image[..., 1]
    means = image[..., 0] / np.where(sums > 0, sums, 1.0)
    return map_colours(means, sums >= MINIMUM_ROW_SUM)


def expected_depth(scene: OpenedLift, view: str | Camera) -> tuple[np.ndarray, np.ndarray]:
    """The expected depth of the rays of a view, ``sum_j w_j z_j / sum_j w_j``.

    z_j is the depth of a splat's centre along the camera's axis, not along the ray. Opacities are as trained.

    Returns:
        Depths [H, W] f32 in scene units, 0 where no splat covers the pixel; and where one does, [H, W] bool.

    Raises:
        NotFound, InvalidQuery, InvalidLift: as `render` does.
    """
    pose = torch.from_numpy(scene.camera(view).about(scene.splats.origin).viewmat[2].copy())
    depths = (scene.splats.means.double() @ pose[:3] + pose[3]).to(torch.float32)
    values = torch.stack([depths, torch.ones_like(depths)], dim=1)
    image = scene.image(view, lambda camera: scene.raster.render(camera, values, _as_trained(scene)))
    covered = image[..., 1] > 0
    return torch.where(covered, image[..., 0] / image[..., 1], 0.0).numpy(), covered.numpy()


def shown_depth(scene: OpenedLift, view: str | Camera) -> ShownDepth:
    """The expected depths of a view, near bright, from the 1st to the 99th percentile of the covered pixels.

    Raises:
        NotFound, InvalidQuery, InvalidLift: as `render` does.
    """
    depths, covered = expected_depth(scene, view)
    levels = np.zeros(depths.shape, dtype=np.uint8)
    if not covered.any():
        return ShownDepth(levels, None)
    near, far = (float(depth) for depth in np.quantile(depths[covered], _SHOWN))
    nearness = (far - depths[covered]) / (far - near) if far > near else np.ones(int(covered.sum()))
    levels[covered] = 1 + np.round(_LEVELS * nearness.clip(0.0, 1.0))
    return ShownDepth(levels, (near, far))


def _as_trained(scene: OpenedLift) -> CompositingParams:
    return CompositingParams(antialiased=scene.compositing.antialiased)


def overlay_png(
    scene: OpenedLift, seen: ViewMask, view: str | Camera, name: str, photo: Image.Image | None = None
) -> bytes:
    """What was found, in the photo of its view or else a render, with a caption that says its share of the picture.

    Raises:
        NotFound, InvalidQuery, InvalidLift: as `render` does.
    """
    height, width = seen.mask.shape
    image = render(scene, view) if photo is None else np.asarray(photo.convert("RGB").resize((width, height)))
    size = max(12, height // 30)
    canvas = Image.new("RGB", (width, height + 2 * size), "white")
    canvas.paste(Image.fromarray(overlay(image, seen.mask)), (0, 0))
    caption = f"{name}: {seen.mask.mean():.1%} of {seen.view}"
    ImageDraw.Draw(canvas).text(
        (size // 2, height + size // 2), caption, fill="black", font=ImageFont.load_default(size)
    )
    return _png(np.asarray(canvas))


def overlay(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[H, W, 3] u8: an image with a mask [H, W] bool tinted and outlined, and the rest dimmed.

    The tint tells a mask of everything from none at all.
    """
    tinted = (1 - _TINT) * image + _TINT * _OUTLINE
    picture = np.where(mask[..., None], tinted, _DIM * image).astype(np.uint8)
    padded, (height, width) = np.pad(mask, 1), mask.shape
    near = np.zeros_like(mask)  # pixels that touch the mask, sideways or diagonally
    for dy in range(3):
        for dx in range(3):
            near |= padded[dy : dy + height, dx : dx + width]
    picture[near & ~mask] = _OUTLINE
    return picture


def _png(pixels: np.ndarray, text: Mapping[str, str] | None = None) -> bytes:
    """A picture [H, W] or [H, W, 3] u8 with text chunks."""
    buffer, chunks = io.BytesIO(), PngInfo()
    for name, value in (text or {}).items():
        chunks.add_text(name, value)
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, format="PNG", pnginfo=chunks)
    return buffer.getvalue()
