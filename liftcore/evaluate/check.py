"""Do splats, cameras, photos and features belong together? What is wrong is told before the work.

Nothing here knows how good a scene is. Each measure has its own control: a render is held against other views' photos
too, the edges of masks against the same masks mirrored, and features as `liftcore.planning.contradictions` has it.
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
from liftcore.features.lens import photo_as_pinhole_sees
from liftcore.features.pack import Views, pair
from liftcore.features.smoothness import smoothness, unlike_maps
from liftcore.features.views import FeatureGrid, Regions
from liftcore.planning.contradictions import (
    FRAME,
    LEAST_IN_VIEW,
    LEAST_ROW_SUM,
    agreement_of_views,
    disagreement,
    empty,
    unseen,
)
from liftcore.planning.views import visibility
from liftcore.progress import Progress, silent
from liftcore.query.render import in_photo
from liftcore.query.splat_colours import seen_colours
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.cameras import Camera, Cameras, photo_size
from liftcore.scene.panorama import with_panoramas
from liftcore.scene.splats import Splats
from liftcore.scene.views import cameras_of_views, some_of
from liftcore.settings import LiftSettings
from liftcore.solve.geometry import LiftViews

VIEWS = 12  # that are looked at, evenly spread
CONTROLS = 3  # other photos that a render is held against
LEAST_GAIN = 3.0  # dB, of a render over other views' photos to its own
LEAST_EDGES = 1.1  # of the photo's edges under masks, over those under mirrored ones


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
    notes = [f"splats: {warning}" for warning in splats.warnings]
    photos = photos or {}
    paired = cameras_of_views(photos, with_panoramas(cameras))
    taken = {name: photos[view] for view, name in paired.items()}
    faces = {name: camera.face.photo for name, camera in cameras.items() if camera.face is not None}
    files = {name: taken[photo] for name, photo in faces.items() if photo in taken and name not in taken}
    panoramas = frozenset(files)  # of which a file is the panorama, and not the camera's own photo
    files |= {name: file for name, file in taken.items() if name in cameras}
    if not photos:
        what = "so the features alone tell" if features is not None else "so nothing tells"
        notes.append(f"photos: none were given, {what} whether these cameras are those of the splats")
    elif not files:
        named = f"{some_of(photos)}, but the cameras {some_of(cameras)}"
        wrong.append(f"photos: none is named as a camera: the photos are {named}")
    else:
        bare, lost = [name for name in cameras if name not in files], [name for name in photos if name not in paired]
        notes += [f"photos: {len(bare)} cameras have none: {some_of(bare)}"] if bare else []
        notes += [f"photos: {len(lost)} have no camera: {some_of(lost)}"] if lost else []
    names = _some(list(files) or list(cameras), VIEWS)
    shown = [name for name in names if name in files]
    whole = {name: cameras[name] if name in panoramas else None for name in files}
    pictures = {name: _photo(files[name], photo_size(cameras[name]), whole[name]) for name in shown}
    raster, views, renders = CpuRaster(splats, threads=None), [], {}
    for number, name in enumerate(names):
        row_sum, renders[name] = _render(raster, splats, cameras[name])
        views.append(_against(name, row_sum, renders[name] if splats.sh is not None else None, pictures))
        progress("check", number + 1, len(names), "views")
    in_view = visibility(splats, list(cameras.values()), CompositingParams()).seen_share
    wrong += _wrong_cameras(views, in_view)
    figures: dict[str, float] = {}
    if features is not None:
        figures, told = _check_features(features, cameras, files, whole)
        settings = LiftSettings.of()
        lifted = LiftViews.of(features, cameras, settings)
        agreement = agreement_of_views(raster, lifted, settings).agreement
        if agreement is not None:
            figures["agreement_of_views"] = agreement
            if not (told or wrong):  # other cameras are told already, and broken maps agree nowhere
                told += disagreement(raster, lifted, settings, agreement)
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


def _photo(path: Path, size: tuple[int, int], panorama: Camera | None) -> np.ndarray:
    """[H, W, 3] f32 in 0..1, a photo in a size (width, height); of a ``panorama`` what that camera, a face, sees."""
    image = read_image(path)[0].convert("RGB")
    if panorama is not None and panorama.face is not None:
        whole = image.resize((panorama.face.width, panorama.face.height), Image.Resampling.BOX)
        image = Image.fromarray(photo_as_pinhole_sees(np.asarray(whole), panorama))
    return np.asarray(image.resize(size, Image.Resampling.BOX), np.float32) / 255


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
    if row_sum < LEAST_ROW_SUM:
        wrong.append(empty(row_sum))
    if in_view < LEAST_IN_VIEW:
        wrong.append(unseen(in_view))
    gains = [view.psnr - view.others for view in views if view.psnr is not None and view.others is not None]
    if gains and float(np.median(gains)) < LEAST_GAIN:
        psnr = float(np.median([view.psnr for view in views if view.psnr is not None]))
        told = f"renders are hardly more like their own photos ({psnr:.1f} dB) than like other views'"
        wrong.append(f"photos: {told} ({np.median(gains):+.1f} dB); {FRAME}, and photos must be those of the cameras")
    return wrong


def _check_features(
    features: Views, cameras: Cameras, files: Mapping[str, Path], whole: Mapping[str, Camera | None]
) -> tuple[dict[str, float], list[str]]:
    """Medians over some views, and what is wrong by them."""
    views = pair(features, cameras)[0]
    grids: list[np.ndarray] = []
    rows: list[tuple[float, float]] = []
    for name in _some(views.views, VIEWS):
        observed = views[name]
        if isinstance(observed, FeatureGrid):
            grids.append(observed.grid.float().numpy())
        elif isinstance(observed, Regions) and name in files:
            labels = observed.labels[-1].numpy()
            photo = _photo(files[name], labels.shape[::-1], whole[name]).mean(axis=2)
            mirrored = max(_edges(labels[:, ::-1], photo), _edges(labels[::-1], photo))
            rows.append((_edges(labels, photo), mirrored))
    figures, wrong = {}, unlike_maps(grids)
    if grids:
        found = smoothness(grids)
        figures |= {"neighbouring_cells": found.neighbours, "any_two_cells": found.anyone, **found.readings}
    if rows:
        own, mirrored = np.median(np.array(rows), axis=0).tolist()
        figures |= {"edges": own, "edges_of_mirrored": mirrored}
        if own < LEAST_EDGES * mirrored:
            told = f"edges of photos are {own:.2f} of the mean under the masks' borders"
            control = f"{mirrored:.2f} under mirrored ones"
            wrong.append(
                f"features: {told}, {control}: masks must be of these photos, upright, whole, not transposed"
            )
    return figures, wrong


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
