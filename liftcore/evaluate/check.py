"""Do splats, cameras, photos and features belong together? What is wrong is told before the work.

Nothing here knows how good a scene is. Each measure has its own control: a render is held against other views' photos
too, neighbouring cells of a grid against any two cells and against other readings of the same bytes, and the edges of
masks against the same masks mirrored.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from liftcore.features.encoders.encode import read_image
from liftcore.features.pack import Views, pair
from liftcore.features.views import FeatureGrid, Regions
from liftcore.planning.views import visibility
from liftcore.progress import Progress, silent
from liftcore.query.render import in_photo
from liftcore.query.splat_colours import seen_colours
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.cameras import Camera, Cameras, photo_size
from liftcore.scene.splats import Splats
from liftcore.scene.views import cameras_of_views, some_of

VIEWS = 12  # that are looked at, evenly spread
CONTROLS = 3  # other photos that a render is held against
LEAST_ROW_SUM = 0.05  # in the mean of a view: a scene of one object before nothing has a fifth or so
LEAST_IN_VIEW = 0.05  # of the splats
LEAST_GAIN = 3.0  # dB, of a render over other views' photos to its own
LEAST_SMOOTHNESS = 0.1  # of neighbouring cells' agreement over that of any two, as a share of what is left to one
LEAST_EDGES = 1.1  # of the photo's edges under masks, over those under mirrored ones
READINGS = {"[F, h, w]": (1, 2, 0), "[w, h, F]": (1, 0, 2)}  # of the same bytes, and how their axes become h, w, F


@dataclass(frozen=True)
class ViewCheck:
    """A view beside its photo."""

    view: str
    row_sum: float  # the mean of A 1
    psnr: float | None  # dB, of the render to the photo; None without a photo or colours
    others: float | None  # dB, the mean to other views' photos


@dataclass(frozen=True)
class CheckReport:
    """What was looked at, and what is wrong."""

    views: tuple[ViewCheck, ...]
    in_view: float  # share of the splats that some camera can see
    features: Mapping[str, float]  # medians over views of what applies
    wrong: tuple[str, ...]  # a sentence each: what was found, and what to do
    notes: tuple[str, ...]  # what may be so on purpose
    worst: bytes | None  # PNG of the view that is least like its photo: the photo, and the render beside it


def check_scene(
    splats: Splats,
    cameras: Cameras,
    photos: Mapping[str, Path] | None = None,
    features: Views | None = None,
    progress: Progress = silent,
) -> CheckReport:
    """Render some views and hold them against what is known of them.

    Args:
        photos: view -> image (`liftcore.features.encoders.encode.find_images`). features: of the views.
        progress: told about a stage "check", in views.

    Raises:
        InvalidInput: an image that cannot be read. InvalidFeatures: features that cannot be read.
    """
    wrong: list[str] = []
    notes: list[str] = []
    photos = photos or {}
    paired = cameras_of_views(photos, cameras)
    files = {camera: photos[view] for view, camera in paired.items()}
    if not photos:
        notes.append("photos: none were given, so nothing tells whether these cameras are those of the splats")
    elif not files:
        named = f"{some_of(photos)}, but the cameras {some_of(cameras)}"
        wrong.append(f"photos: none is named as a camera: the photos are {named}")
    else:
        bare, lost = [name for name in cameras if name not in files], [name for name in photos if name not in paired]
        notes += [f"photos: {len(bare)} cameras have none: {some_of(bare)}"] if bare else []
        notes += [f"photos: {len(lost)} have no camera: {some_of(lost)}"] if lost else []
    names = _some(list(files) or list(cameras), VIEWS)
    shown = [name for name in names if name in files]
    pictures = {name: _pixels(read_image(files[name])[0], photo_size(cameras[name])) for name in shown}
    raster, views, renders = CpuRaster(splats, threads=None), [], {}
    for number, name in enumerate(names):
        row_sum, renders[name] = _render(raster, splats, cameras[name])
        views.append(_against(name, row_sum, renders[name] if splats.sh is not None else None, pictures))
        progress("check", number + 1, len(names), "views")
    in_view = visibility(splats, list(cameras.values()), CompositingParams()).seen_share
    wrong += _wrong_cameras(views, in_view)
    figures: dict[str, float] = {}
    if features is not None:
        figures, told = _check_features(features, cameras, files)
        wrong += told
    compared = [view for view in views if view.psnr is not None]
    worst = min(compared, key=lambda view: view.psnr or 0.0).view if compared else None
    side_by_side = _png(np.concatenate([pictures[worst], renders[worst]], axis=1)) if worst else None
    return CheckReport(tuple(views), in_view, figures, tuple(wrong), tuple(notes), side_by_side)


def _some(names: Sequence[str], count: int) -> list[str]:
    """As many of the names, evenly spread."""
    places = np.linspace(0, len(names) - 1, min(count, len(names))).round()
    return [names[int(place)] for place in places]


def _render(raster: CpuRaster, splats: Splats, camera: Camera) -> tuple[float, np.ndarray]:
    """The mean row sum of a view and its colours [H, W, 3] f32 in 0..1, in the pixels of its photo."""
    values = torch.cat([seen_colours(splats, camera), torch.ones(splats.count, 1)], dim=1)
    image = in_photo(camera, lambda of: raster.render(of, values, CompositingParams())).numpy()
    return float(image[..., 3].mean()), image[..., :3].clip(0.0, 1.0)


def _pixels(image: Image.Image, size: tuple[int, int]) -> np.ndarray:
    """[H, W, 3] f32 in 0..1 of an image in a size (width, height)."""
    return np.asarray(image.convert("RGB").resize(size, Image.Resampling.BOX), np.float32) / 255


def _against(name: str, row_sum: float, render: np.ndarray | None, pictures: Mapping[str, np.ndarray]) -> ViewCheck:
    if render is None or name not in pictures:
        return ViewCheck(name, row_sum, None, None)
    others = [view for view in pictures if view != name and pictures[view].shape == render.shape]
    controls = [_psnr(render, pictures[view]) for view in _some(others, CONTROLS)]
    return ViewCheck(name, row_sum, _psnr(render, pictures[name]), float(np.mean(controls)) if controls else None)


def _psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.square(one - other, dtype=np.float64).mean(), 1e-10)))


def _wrong_cameras(views: Sequence[ViewCheck], in_view: float) -> list[str]:
    wrong, row_sum = [], float(np.median([view.row_sum for view in views]))
    frame = "cameras and splats must share a frame: look for the trainer's transform, a scale or another scene"
    if row_sum < LEAST_ROW_SUM:
        wrong.append(f"cameras: splats fill {row_sum:.1%} of the rays of a view; {frame}")
    if in_view < LEAST_IN_VIEW:
        wrong.append(f"cameras: no camera can see {1 - in_view:.1%} of the splats; {frame}")
    gains = [view.psnr - view.others for view in views if view.psnr is not None and view.others is not None]
    if gains and float(np.median(gains)) < LEAST_GAIN:
        psnr = float(np.median([view.psnr for view in views if view.psnr is not None]))
        told = f"renders are hardly more like their own photos ({psnr:.1f} dB) than like other views'"
        wrong.append(f"photos: {told} ({np.median(gains):+.1f} dB); {frame}, and photos must be those of the cameras")
    return wrong


def _check_features(
    features: Views, cameras: Cameras, files: Mapping[str, Path]
) -> tuple[dict[str, float], list[str]]:
    """Medians over some views, and what is wrong by them."""
    views = pair(features, cameras)[0]
    rows: dict[str, list[float]] = {}

    def take(name: str, value: float) -> None:
        rows.setdefault(name, []).append(value)

    for name in _some(views.views, VIEWS):
        observed = views[name]
        if isinstance(observed, FeatureGrid):
            grid = observed.grid.float().numpy()
            neighbours, anyone = _agreement(grid)
            take("smoothness", (neighbours - anyone) / max(1 - anyone, 1e-6))
            take("neighbours", neighbours)
            for reading, axes in READINGS.items():
                shape = np.array(grid.shape)[np.argsort(axes)]
                take(reading, _agreement(grid.reshape(shape).transpose(axes))[0])
        elif isinstance(observed, Regions) and name in files:
            labels = observed.labels[-1].numpy()
            photo = _pixels(read_image(files[name])[0], labels.shape[::-1]).mean(axis=2)
            own, mirrored = _edges(labels, photo), max(_edges(labels[:, ::-1], photo), _edges(labels[::-1], photo))
            take("edges", own)
            take("edges_of_mirrored", mirrored)
    figures = {name: float(np.median(values)) for name, values in rows.items()}
    wrong = []
    if "neighbours" in figures:
        best = max(READINGS, key=lambda reading: figures[reading])
        gap = figures[best] - figures["neighbours"]
        agree = f"neighbouring cells agree to {figures['neighbours']:.2f}"
        if gap > LEAST_SMOOTHNESS:
            told = f"read as {best} they would to {figures[best]:.2f}: the bytes lie in that order"
            wrong.append(f"features: {agree}, {told}; write the maps anew, from arrays that are contiguous")
        elif figures["smoothness"] < LEAST_SMOOTHNESS:
            wrong.append(f"features: {agree}, as any two cells do: the maps show nothing of the photos")
    if "edges" in figures and figures["edges"] < LEAST_EDGES * figures["edges_of_mirrored"]:
        told = f"edges of photos are {figures['edges']:.2f} of the mean under the masks' borders"
        control = f"{figures['edges_of_mirrored']:.2f} under mirrored ones"
        wrong.append(f"features: {told}, {control}: masks must be of these photos, upright, whole, not transposed")
    return figures, wrong


def _agreement(grid: np.ndarray) -> tuple[float, float]:
    """The mean cosine of neighbouring cells of a grid [h, w, F], and of any two."""
    unit = grid / np.maximum(np.linalg.norm(grid, axis=2, keepdims=True), 1e-12)
    down, across = (unit[1:] * unit[:-1]).sum(axis=2), (unit[:, 1:] * unit[:, :-1]).sum(axis=2)
    mean = unit.reshape(-1, unit.shape[2]).mean(axis=0)
    count = unit.shape[0] * unit.shape[1]
    anyone = (count * float(mean @ mean) - 1) / max(count - 1, 1)
    return float(np.concatenate([down.ravel(), across.ravel()]).mean()) if count > 1 else 1.0, anyone


def _edges(labels: np.ndarray, photo: np.ndarray) -> float:
    """How strong a photo's edges [h, w] are where the labels [h, w] change, over their mean."""
    down, across = np.abs(np.diff(photo, axis=0))[:, :-1], np.abs(np.diff(photo, axis=1))[:-1]
    strength = np.maximum(down, across)
    border = (labels[1:, :-1] != labels[:-1, :-1]) | (labels[:-1, 1:] != labels[:-1, :-1])
    return float(strength[border].mean() / max(strength.mean(), 1e-12)) if border.any() else 1.0


def _png(pixels: np.ndarray) -> bytes:
    content = io.BytesIO()
    Image.fromarray((255 * pixels).round().astype(np.uint8)).save(content, format="PNG")
    return content.getvalue()
