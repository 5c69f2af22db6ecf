"""Images of a scene and its answers from a camera: masks, attention, colours and depths, in the photo's pixels."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo
from scipy.ndimage import binary_dilation

from liftcore.query.areas import MINIMUM_ROW_SUM
from liftcore.query.colours import cluster_colours, heat_colours, map_colours
from liftcore.query.objects import objects
from liftcore.query.question import Answer
from liftcore.query.scene import Scene
from liftcore.query.splat_colours import view_colours
from liftcore.runtime.one_line import one_line, value_text
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams

LEAST_SHARE = 0.5  # of a ray's weight, that the objects need for the mask
MOST_GROUPED = 1 << 17  # selected splats that are grouped for a mask: this many take .4 s of two cores
_DEPTH_QUANTILES = (0.01, 0.99)  # of the covered pixels: a floater before the lens does not darken the picture
_LEVELS = 254  # between the farthest covered pixel, at 1, and the nearest, at 255; 0 is for pixels without splats
_DIM = 0.35  # brightness of an overlay outside the mask
_TINT = 0.25  # share of the outline's colour inside the mask
_OUTLINE = np.array([255, 209, 64], dtype=np.uint8)  # sRGB of the line around the mask


@dataclass(frozen=True)
class ViewMask:
    """Attention and mask of an answer from one camera."""

    view: str
    """the name of its camera"""
    attention: np.ndarray
    """[H, W] f32, A s: scores rendered with the lift's scale of opacity; 0 if the object is absent"""
    row_sums: np.ndarray
    """[H, W] f32, A 1"""
    mask: np.ndarray
    """[H, W] bool, pixels on which the objects have at least half of the weight of a ray that hits the scene"""
    explanation: str
    """one sentence on the meaning of the mask"""

    def __repr__(self) -> str:
        size = f"{list(self.mask.shape)} pixels, {self.mask.mean():.1%} of them in the mask"
        return one_line(self, value_text(self.view), size, value_text(self.explanation))


def view_mask(scene: Scene, answer: Answer, view: str | Camera) -> ViewMask:
    """Render an answer from a camera: its attention, and a mask of its objects.

    The mask is ``A m >= A 1 / 2``, with m = 1 for the splats of the answer's objects: the pixels where they are
    visible. It has no threshold of its own, so it is empty in a view that does not see them. Above 131,072 selected
    splats, all of them are in the mask, also unassigned ones, unless the query keeps some of the objects.

    Args:
        scene: the opened lift. answer: of that lift.
        view: the name of a camera, lifted or not; or any camera in the frame of the splats.

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: the view's image is larger than pictures may be; or the largest of more splats than are grouped.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    camera = scene.camera(view)  # first, so that an unknown name raises before the work
    if answer.count > MOST_GROUPED and not answer.query.keeps_some:
        members, subject = answer.selected, f"all {answer.count} selected splats, too many to group into objects"
    else:
        groups = objects(scene, answer)
        members, count = groups.numbers >= 0, len(groups.objects)
        subject = f"the {count} object{'s' * (count != 1)} that {'were' if count != 1 else 'was'} found"
    # A splat without a feature has a score of -1, which would lower the attention of its neighbours: it counts as 0.
    scores = np.where(answer.has_feature & (not answer.is_dropped), answer.scores, np.float32(0.0))
    values = torch.from_numpy(np.stack([scores, members.astype(np.float32), np.ones_like(scores)], axis=1))
    image = scene.image(camera, lambda of: scene.raster.render(of, values, scene.compositing)).numpy()
    attention, weights, row_sums = (np.ascontiguousarray(image[..., column]) for column in range(3))
    mask = (row_sums >= MINIMUM_ROW_SUM) & (weights >= LEAST_SHARE * row_sums)
    return ViewMask(camera.name, attention, row_sums, mask, f"at least half of the ray is of {subject}")


def mask_png(mask: np.ndarray) -> bytes:
    """Write a mask [H, W] bool as a PNG of one 8-bit channel, white inside."""
    return png(mask.astype(np.uint8) * 255)


def attention_png(in_view: ViewMask) -> bytes:
    """Write the attention in colours of the map as a PNG, RGB [H, W, 3]; black where the ray misses the scene."""
    return png(heat_colours(in_view.attention, in_view.row_sums > 0))


def render_png(scene: Scene, view: str | Camera, channel: str = "rgb") -> bytes:
    """Render the scene from a camera as a PNG, RGB [H, W, 3] on black: colours, features (``pca``) or clusters.

    ``depth`` is one 8-bit channel [H, W], near bright; the PNG has its range as text, ``depth-near`` and
    ``depth-far``, in decimals that read back exactly.
    """
    if channel == "depth":
        levels, span = shown_depth(scene, view)
        text = {} if span is None else {"depth-near": repr(span[0]), "depth-far": repr(span[1])}
        return png(levels, text)
    return png(render(scene, view, channel))


def render(scene: Scene, view: str | Camera, channel: str = "rgb") -> np.ndarray:
    """Render the colours of a view, [H, W, 3] u8 sRGB on black, with the opacities as trained.

    ``rgb`` takes the splats' colours, ``pca`` the first three principal components of their features, and ``cluster``
    a colour a cluster: the cluster of the most weight on each ray, with the opacities of the lift. It is grey where
    unclustered splats have the most. ``confidence`` is the mean confidence of the splats on each ray, in colours of
    the map of scores, which spans it from 0 to 1.

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: the lift has no clusters, or no confidence; or the image is larger than pictures may be.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    if channel == "cluster":
        return _render_clusters(scene, view)
    if channel == "confidence":
        return _render_confidence(scene, view)
    colours = scene.principal if channel == "pca" else view_colours(scene.splats, scene.camera(view))
    levels = scene.image(view, lambda camera: scene.raster.render(camera, colours, _as_trained(scene))).numpy()
    np.clip(levels, 0.0, 1.0, out=levels)  # in place: an image of floats is large
    levels *= 255
    return np.round(levels, out=levels).astype(np.uint8)


def _render_clusters(scene: Scene, view: str | Camera) -> np.ndarray:
    clusters = scene.layer("cluster")
    labels, sums = scene.strongest_labels(clusters, view)
    picture = cluster_colours(int(clusters.max()) + 1)[labels]  # the last colour is that of label -1
    picture[sums <= 0] = 0
    return picture


def _render_confidence(scene: Scene, view: str | Camera) -> np.ndarray:
    confidence = torch.from_numpy(scene.layer("confidence"))
    means, sums = _means(scene, view, confidence, scene.compositing)
    return map_colours(means, sums >= MINIMUM_ROW_SUM)


def expected_depth(scene: Scene, view: str | Camera) -> tuple[np.ndarray, np.ndarray]:
    """Render the expected depth of the rays of a view, ``sum_j w_j z_j / sum_j w_j``.

    z_j is the depth of a splat's centre along the camera's axis, not along the ray. Opacities are as trained.

    Returns:
        Depths [H, W] f32 in scene units, 0 where no splat covers the pixel; and the covered pixels, [H, W] bool.
    """
    pose = torch.from_numpy(scene.camera(view).about(scene.splats.origin).viewmat[2].copy())
    depths = (scene.splats.means.double() @ pose[:3] + pose[3]).to(torch.float32)
    means, sums = _means(scene, view, depths, _as_trained(scene))
    return means, sums > 0


def _means(
    scene: Scene, view: str | Camera, values: torch.Tensor, params: CompositingParams
) -> tuple[np.ndarray, np.ndarray]:
    """Render the mean of the splats' values [P] on each ray, [H, W] f32, 0 where no splat is; and the row sums."""
    columns = torch.stack([values, torch.ones_like(values)], dim=1)
    image = scene.image(view, lambda camera: scene.raster.render(camera, columns, params))
    totals, sums = image.unbind(dim=2)
    return torch.where(sums > 0, totals / sums, 0.0).numpy(), sums.numpy()


def shown_depth(scene: Scene, view: str | Camera) -> tuple[np.ndarray, tuple[float, float] | None]:
    """Map the expected depths of a view to grey, near bright, from the 1st to the 99th percentile of covered pixels.

    Returns:
        Levels [H, W] u8: 1 is the far end or farther, 255 the near end or nearer, and 0 no depth; and the ends near
        and far, scene units, None when no pixel is covered.
    """
    depths, hit = expected_depth(scene, view)
    levels = np.zeros(depths.shape, dtype=np.uint8)
    if not hit.any():
        return levels, None
    near, far = (float(depth) for depth in np.quantile(depths[hit], _DEPTH_QUANTILES))
    nearness = (far - depths[hit]) / (far - near) if far > near else np.ones(int(hit.sum()))
    levels[hit] = 1 + np.round(_LEVELS * nearness.clip(0.0, 1.0))
    return levels, (near, far)


def _as_trained(scene: Scene) -> CompositingParams:
    return CompositingParams(antialiased=scene.compositing.antialiased)


def overlay_png(
    scene: Scene, in_view: ViewMask, view: str | Camera, name: str, photo: Image.Image | None = None
) -> bytes:
    """Overlay an answer's mask on the photo of its view or a render, with its share of the image as a caption."""
    height, width = in_view.mask.shape
    image = render(scene, view) if photo is None else np.asarray(photo.convert("RGB").resize((width, height)))
    caption = f"{name}: {in_view.mask.mean():.1%} of {in_view.view}"
    return captioned_png(overlay(image, in_view.mask), [(caption, _OUTLINE)])


def captioned_png(image: np.ndarray, lines: Sequence[tuple[str, np.ndarray]]) -> bytes:
    """Write an image [H, W, 3] u8 with lines of text below, each after a square of its colour [3] u8, as a PNG."""
    height, width, _ = image.shape
    size = max(12, height // 30)
    canvas = Image.new("RGB", (width, height + 2 * size * len(lines)), "white")
    canvas.paste(Image.fromarray(image), (0, 0))
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size)
    for line, (text, colour) in enumerate(lines):
        top = height + 2 * size * line + size // 2
        draw.rectangle((size // 2, top, 3 * size // 2, top + size), fill=tuple(colour.tolist()))
        draw.text((2 * size, top), text, fill="black", font=font)
    return png(np.asarray(canvas))


def overlay(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Tint and outline a mask [H, W] bool in an image, and dim the rest; [H, W, 3] u8.

    The tint distinguishes a full mask from an empty one.
    """
    tinted = (1 - _TINT) * image + _TINT * _OUTLINE
    picture = np.where(mask[..., None], tinted, _DIM * image).astype(np.uint8)
    near = binary_dilation(mask, np.ones((3, 3)))  # pixels that touch the mask, sideways or diagonally
    picture[near & ~mask] = _OUTLINE
    return picture


def png(pixels: np.ndarray, text: Mapping[str, str] | None = None, palette: np.ndarray | None = None) -> bytes:
    """Write an image [H, W] u8 or u16, or [H, W, 3] u8, as a PNG with text chunks, and a palette [n, 3] u8."""
    content, chunks = io.BytesIO(), PngInfo()
    for name, value in (text or {}).items():
        chunks.add_text(name, value)
    image = Image.fromarray(np.ascontiguousarray(pixels))
    if palette is not None:
        image.putpalette(palette.tobytes())
    image.save(content, format="PNG", pnginfo=chunks)
    return content.getvalue()
