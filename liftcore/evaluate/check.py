"""A check, before a lift, that splats, cameras, photos and features belong together.

No measure needs to know the quality of a scene, as each has its own control: a render is compared with other views'
photos too, the edges of masks with those of the mirrored masks, and features as `lifting.planning.contradictions`
does.

Photos of another shape than their cameras are found by their headers, and compared no further. If renders do not
match their photos, three causes are tried: turned or mirrored photos, intrinsics of a picture of another size, and
positions in another scale. A cause is reported if it makes renders match their photos; else none is.

What has nothing to compare is not wrong: renders that match their photos far better than an empty picture does, such
as of one object on nothing; and masks whose borders lie where the photo has no edges.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from liftcore.features.encoders.encode import find_images, read_image
from liftcore.features.smoothness import smoothness, unlike_maps
from liftcore.io.cameras import read_cameras
from liftcore.io.photos import PhotoHeader, orientation_warnings, read_header
from liftcore.io.splats import read_splats
from liftcore.lifting.planning.contradictions import (
    LEAST_IN_VIEW,
    LEAST_ROW_SUM,
    agreement_of_views,
    disagreement,
    empty,
    unseen,
)
from liftcore.lifting.planning.views import evenly_spaced, visibility
from liftcore.query.splat_colours import view_colours
from liftcore.raster import open_raster
from liftcore.raster.base import Raster
from liftcore.runtime.arguments import as_list, as_path
from liftcore.runtime.device import CPU
from liftcore.runtime.progress import Progress, shown_progress
from liftcore.scene.cameras import Camera, Cameras, intrinsics_advice, intrinsics_factor
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.drawing import in_photo
from liftcore.scene.render_mode import rendering_reason, rendering_warnings
from liftcore.scene.splats import Splats
from liftcore.scene.views import cameras_of_views, first_names
from liftcore.solve.diagnostics import is_stretched, shape_warnings
from liftcore.values.fit import FITS
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import Views, pair, read_features
from liftcore.values.settings import LiftSettings
from liftcore.values.views import FeatureGrid, Regions

VIEWS = 12  # that are checked, evenly spread
CONTROLS = 3  # photos of other views that a render is compared with
SCALES = 0.5, 2.0, 0.25, 3.0, 4.0  # of the cameras' positions, that are tried
LEAST_GAIN = 3.0  # dB, of a render over other views' photos to its own
MATCHING = 30.0  # dB of a render to its photo, at which other views and the filled share of rays need not be asked
SCALED_VIEWS = 4  # that are rendered again for each scale
LEAST_LIKENESS_GAIN, MOST_VIEWS = 0.05, 0.75  # of a fit of maps over the one that is read, and of views that show it
LEAST_BORDERS = 0.75  # of the photo's mean edge, under masks' borders or mirrored ones, below which nothing is told
LEAST_EDGES = 1.1  # of the photo's edges under masks, over those under mirrored ones


TURNS = {  # by EXIF's orientation: what it does to a picture [H, W, 3], in words and by NumPy
    2: ("mirrored left to right", lambda picture: picture[:, ::-1]),
    3: ("turned by 180 degrees", lambda picture: picture[::-1, ::-1]),
    4: ("mirrored upside down", lambda picture: picture[::-1]),
    5: ("transposed", lambda picture: picture.swapaxes(0, 1)),
    6: ("turned by 90 degrees clockwise", lambda picture: np.rot90(picture, 3)),
    7: ("transposed across", lambda picture: picture[::-1, ::-1].swapaxes(0, 1)),
    8: ("turned by 90 degrees counterclockwise", np.rot90),
}


@dataclass(frozen=True)
class ViewCheck:
    """The comparison of a render with its photo."""

    view: str
    row_sum: float  # the mean of A 1
    psnr: float | None  # dB, of the render to the photo; None without a photo or colours
    other_psnr: float | None  # dB, the mean to other views' photos


@dataclass(frozen=True)
class CheckReport:
    """The result of a check."""

    views: tuple[ViewCheck, ...]
    in_view: float  # share of the splats that some camera can see
    features: Mapping[str, float]  # medians over views of what applies
    wrong: tuple[str, ...]  # a sentence each: a contradiction, and what to do
    notes: tuple[str, ...]  # remarks on what may be intended
    worst: bytes | None  # PNG of the view with the lowest PSNR: the photo, and the render beside it


def check_scene(
    splats: Splats | Path | str,
    cameras: Cameras | Path | str,
    photos: Mapping[str, Path | str] | Path | str | Sequence[Path | str] | None = None,
    features: Views | Path | str | Sequence[Path | str] | None = None,
    progress: Progress | bool | None = False,
    settings: LiftSettings | None = None,
) -> CheckReport:
    """Render some views, and compare them with their photos; check features against cameras and photos.

    Args:
        splats, cameras: or their paths, as `read_splats` and `read_cameras` take them.
        photos: view -> image; or images and folders of them. features: of the views; or the paths of feature packs.
        progress: as in `liftcore.lift`; reports a stage "check", in views.
        settings: of the later lift, for its ``antialiased``. None: the defaults.

    Raises:
        InvalidInput: an image that cannot be read. InvalidFeatures: features that cannot be read.
        InvalidSplats, InvalidCameras: as in readers of splats and cameras.
    """
    settings = LiftSettings.or_default(settings)
    features = features if features is None or isinstance(features, Views) else read_features(*as_list(features))
    if isinstance(photos, Mapping):
        images = {view: as_path(file, "photos") for view, file in photos.items()}
    else:
        images = find_images(photos or ())
    splats = splats if isinstance(splats, Splats) else read_splats(splats, settings.kernel)
    if not isinstance(cameras, Cameras):
        cameras = read_cameras(cameras)
    with shown_progress(progress) as reporter:
        return _check(splats, cameras, images, features, reporter, settings.for_splats(splats))


def _check(
    splats: Splats,
    cameras: Cameras,
    photos: Mapping[str, Path],
    features: Views | None,
    progress: Progress,
    settings: LiftSettings,
) -> CheckReport:
    trained = CompositingParams(antialiased=settings.antialiased is True)
    wrong: list[str] = []
    of_splats = *rendering_warnings(splats.render_mode, trained.antialiased, splats.kernel), *splats.warnings
    notes = [*(f"splats: {text}" for text in of_splats), *(f"cameras: {text}" for text in cameras.warnings)]
    if trained.antialiased:
        notes.append(f"splats: rendered antialiased: {rendering_reason(splats.render_mode, True)}")
    files = _paired_photos(photos, cameras, features is not None, wrong, notes)
    sizes = {name: cameras[name].photo_size for name in files}
    headers = {name: read_header(file) for name, file in files.items()}
    readings = {name: header.reading(sizes[name]) for name, header in headers.items()}
    notes += [f"photos: {line}" for line in orientation_warnings(readings, "their cameras")]
    misshapen, found_wrong = _other_shapes(headers, sizes)
    wrong += found_wrong
    comparable = {name: file for name, file in files.items() if name not in misshapen}
    names = evenly_spaced(list(comparable) or list(cameras), VIEWS)
    with_photo = [name for name in names if name in comparable]
    pictures = {name: _photo(files[name], sizes[name], cameras[name].photo_size) for name in with_photo}
    raster, views, renders = open_raster(splats, CPU), [], {}
    unfilled: dict[str, np.ndarray] = {}
    for number, name in enumerate(names):
        renders[name], unfilled[name] = _render(raster, splats, cameras[name], trained)
        progress("check", number + 1, len(names), "views")
    background = _background(renders, unfilled, pictures)
    for name in names:
        renders[name] = (renders[name] + background * unfilled[name]).clip(0.0, 1.0)
        row_sum = 1.0 - float(unfilled[name].mean())
        views.append(_against(name, row_sum, renders[name] if splats.sh is not None else None, pictures))
    in_view = visibility(splats, list(cameras.values()), trained).seen_share
    if not _match(views, pictures, background):
        scaled = _Scaled(raster, splats, cameras, trained)
        unlike = _unlike_photos(views, pictures, renders, headers, scaled)
        if not unlike or intrinsics_factor([cameras[name] for name in names]) is None:
            wrong += _wrong_cameras(views, in_view)
        wrong += unlike
    figures: dict[str, float] = {}
    if features is not None:
        paired_features = pair(features, cameras)[0]
        figures, found_wrong = _check_features(paired_features, files)
        fit_figures, wrong_fit = _fit_of_maps(paired_features, cameras, files)
        figures |= fit_figures
        found_wrong += wrong_fit
        notes += [
            f"features: {text}"
            for text in shape_warnings(paired_features, [cameras[v] for v in paired_features.views])
        ]
        lifted = LiftViews.of(features, cameras, settings)
        agreement = agreement_of_views(raster, lifted, settings).agreement
        if agreement is not None:
            figures["agreement_of_views"] = agreement
            if not (found_wrong or wrong):  # wrong cameras are reported already, and broken maps agree nowhere
                found_wrong += disagreement(agreement)
        wrong += found_wrong
    with_psnr = [view for view in views if view.psnr is not None]
    worst = min(with_psnr, key=lambda view: view.psnr or 0.0).view if with_psnr else None
    side_by_side = _png(np.concatenate([pictures[worst], renders[worst]], axis=1)) if worst else None
    return CheckReport(tuple(views), in_view, figures, tuple(wrong), tuple(notes), side_by_side)


def _paired_photos(
    photos: Mapping[str, Path], cameras: Cameras, featured: bool, wrong: list[str], notes: list[str]
) -> dict[str, Path]:
    """Pair cameras with photos: camera -> photo.

    Args:
        featured: True if there are features. wrong, notes: lists that messages about the pairs are added to.
    """
    paired = cameras_of_views(photos, cameras)
    files = {name: photos[view] for view, name in paired.items()}
    if not photos:
        consequence = "so the features alone tell" if featured else "so nothing tells"
        notes.append(f"photos: none were given, {consequence} whether these cameras are those of the splats")
    elif not files:
        names = f"{first_names(photos)}, but the cameras {first_names(cameras)}"
        wrong.append(f"photos: none is named as a camera: the photos are {names}")
    else:
        if without_photo := [name for name in cameras if name not in files]:
            notes.append(f"photos: {len(without_photo)} cameras have none: {first_names(without_photo)}")
        if unpaired := [name for name in photos if name not in paired]:
            notes.append(f"photos: {len(unpaired)} have no camera: {first_names(unpaired)}")
    return files


def _render(
    raster: Raster, splats: Splats, camera: Camera, params: CompositingParams
) -> tuple[np.ndarray, np.ndarray]:
    """Render a view over black [H, W, 3] f32 in the pixels of its photo, and the transmittance [H, W, 1] f32."""
    values = torch.cat([view_colours(splats, camera), torch.ones(splats.count, 1, dtype=torch.float32)], dim=1)
    image = in_photo(camera, lambda of: raster.render(of, values, params)).numpy()
    return image[..., :3], 1.0 - image[..., 3:]


def _background(
    renders: Mapping[str, np.ndarray], unfilled: Mapping[str, np.ndarray], pictures: Mapping[str, np.ndarray]
) -> float:
    """Choose white (1) if renders match their photos better on it, as photos without a background do; else 0."""
    gains = [
        _psnr((renders[name] + unfilled[name]).clip(0, 1), photo) - _psnr(renders[name].clip(0, 1), photo)
        for name, photo in pictures.items()
        if photo.shape == renders[name].shape
    ]
    return float(bool(gains) and _median(gains) > 0)


def _other_shapes(
    headers: Mapping[str, PhotoHeader], sizes: Mapping[str, tuple[int, int]]
) -> tuple[set[str], list[str]]:
    """Find views whose photos have another aspect ratio than their cameras; return a message for each kind too."""
    sideways, other_shape = [], []
    for name, header in headers.items():
        size = header.oriented if header.turns_for(sizes[name]) else header.stored
        if not is_stretched(size, sizes[name]):
            continue
        (sideways if not is_stretched((size[1], size[0]), sizes[name]) else other_shape).append(name)
    advice = {
        "lie on their side ({}): take the photos as they were when their cameras were made": sideways,
        "are of another shape than their cameras ({}): crops or other photos": other_shape,
    }
    shapes = {
        name: "{}x{} for a camera of {}x{}".format(*headers[name].stored, *sizes[name])
        for name in sideways + other_shape
    }
    return {*sideways, *other_shape}, [
        f"photos: {len(names)} of {len(headers)} {text.format(f'{names[0]} is {shapes[names[0]]}')}"
        for text, names in advice.items()
        if names
    ]


def _photo(path: Path, like: tuple[int, int], size: tuple[int, int]) -> np.ndarray:
    """Read a photo [H, W, 3] f32 in 0..1 at a size (width, height).

    Args:
        like: width and height that decide the photo's orientation.
    """
    image = read_image(path, like)[0]
    return np.asarray(image.resize(size, Image.Resampling.BOX), np.float32) / 255


def _against(name: str, row_sum: float, render: np.ndarray | None, pictures: Mapping[str, np.ndarray]) -> ViewCheck:
    if render is None or name not in pictures:
        return ViewCheck(name, row_sum, None, None)
    controls = [_psnr(render, photo) for photo in _controls(name, pictures)]
    return ViewCheck(name, row_sum, _psnr(render, pictures[name]), float(np.mean(controls)) if controls else None)


def _psnr(left: np.ndarray, right: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.square(left - right, dtype=np.float64).mean(), 1e-10)))


def _match(views: Sequence[ViewCheck], pictures: Mapping[str, np.ndarray], background: float) -> bool:
    """Return True if each render matches its photo, and does so better than a picture of the background alone."""
    psnrs = {view.view: view.psnr for view in views if view.psnr is not None}
    empty_pictures = [_psnr(np.full_like(pictures[name], background), pictures[name]) for name in psnrs]
    gains = [psnr - other for psnr, other in zip(psnrs.values(), empty_pictures, strict=True)]
    return bool(psnrs) and min(psnrs.values()) >= MATCHING and _median(gains) >= LEAST_GAIN


def _wrong_cameras(views: Sequence[ViewCheck], in_view: float) -> list[str]:
    wrong, row_sum = [], float(np.median([view.row_sum for view in views]))
    if row_sum < LEAST_ROW_SUM:
        wrong.append(empty(row_sum))
    if in_view < LEAST_IN_VIEW:
        wrong.append(unseen(in_view))
    return wrong


@dataclass(frozen=True)
class _Scaled:
    """Renders of a scene with its cameras' positions or intrinsics times a factor."""

    raster: Raster
    splats: Splats
    cameras: Cameras
    params: CompositingParams

    def render(self, view: str, photo: np.ndarray, factor: float, *, intrinsics: bool = False) -> np.ndarray:
        """Render a view [H, W, 3] f32 in 0..1; ``intrinsics`` multiplies these in place of the position."""
        camera, scale = self.cameras[view], np.ones((4, 4))
        scale[:3, 3] = factor
        changes = {name: factor * getattr(camera, name) for name in ("fx", "fy", "cx", "cy")} if intrinsics else {}
        scaled_camera = camera.replace(**(changes or {"viewmat": camera.viewmat * scale}))
        render, unfilled = _render(self.raster, self.splats, scaled_camera, self.params)
        return (render + _background({view: render}, {view: unfilled}, {view: photo}) * unfilled).clip(0.0, 1.0)

    def best(
        self, floor: Mapping[str, float], pictures: Mapping[str, np.ndarray], factors: Iterable[float], **of: bool
    ) -> tuple[float, float]:
        """Return the largest median gain in dB over ``floor`` and other views' photos, and its factor."""
        names, best = evenly_spaced(list(floor), SCALED_VIEWS), (0.0, 1.0)
        for factor in factors:
            gains = []
            for name in names:
                render = self.render(name, pictures[name], factor, **of)
                control = [_psnr(render, photo) for photo in _controls(name, pictures)]
                gains.append(_psnr(render, pictures[name]) - max(floor[name], *control, -np.inf))
            best = max(best, (_median(gains), factor))
        return best


def _unlike_photos(
    views: Sequence[ViewCheck],
    pictures: Mapping[str, np.ndarray],
    renders: Mapping[str, np.ndarray],
    headers: Mapping[str, PhotoHeader],
    scaled: _Scaled,
) -> list[str]:
    """Report renders that do not match their photos, with the cause if one is found; empty if they match."""
    psnrs = {
        view.view: (view.psnr, view.other_psnr)
        for view in views
        if view.psnr is not None and view.other_psnr is not None
    }
    if not psnrs:
        return []
    gain = _median([own_psnr - other for own_psnr, other in psnrs.values()])
    if gain >= LEAST_GAIN:
        return _some_turned(psnrs, pictures, renders)
    typical = _median([own_psnr for own_psnr, _ in psnrs.values()])
    finding = f"photos: renders are hardly more like their own photos ({typical:.1f} dB)"
    finding = f"{finding} than like other views' ({gain:+.1f} dB)"
    floor = {name: max(pair) for name, pair in psnrs.items()}
    cause = (
        _scaled_intrinsics(floor, pictures, scaled)
        or _turned_photos(floor, pictures, renders, headers)
        or _scaled_positions(floor, pictures, scaled)
    )
    unknown = "splats, cameras and photos are not of one scene in one frame, or photos and cameras not of each other"
    return [f"{finding}; {cause or unknown}"]


def _some_turned(
    psnrs: Mapping[str, tuple[float, float]], pictures: Mapping[str, np.ndarray], renders: Mapping[str, np.ndarray]
) -> list[str]:
    """Report single photos that match their renders only when turned, a message a turn."""
    names_by_turn: dict[int, list[str]] = {}
    for name, (own_psnr, other) in psnrs.items():
        if own_psnr - other >= LEAST_GAIN:
            continue
        gains = _turn_gains({name: max(own_psnr, other)}, pictures, renders)
        best = max(gains, key=lambda tag: gains[tag])
        if gains[best] >= LEAST_GAIN:
            names_by_turn.setdefault(best, []).append(name)
    return [
        f"photos: {len(names)} of the {len(psnrs)} compared ({first_names(names)}) are {TURNS[tag][0]}: "
        "take the photos that cameras were made of"
        for tag, names in sorted(names_by_turn.items())
    ]


def _turn_gains(
    floor: Mapping[str, float], pictures: Mapping[str, np.ndarray], renders: Mapping[str, np.ndarray]
) -> dict[int, float]:
    """Return the median gain in dB of renders over ``floor`` by each turn of their photos, where shapes fit."""
    gains: dict[int, list[float]] = {}
    for tag, (_, turn) in TURNS.items():
        for name, least in floor.items():
            picture = turn(pictures[name])
            if picture.shape == renders[name].shape:
                gains.setdefault(tag, []).append(_psnr(renders[name], picture) - least)
    return {tag: _median(values) for tag, values in gains.items()}


def _turned_photos(
    floor: Mapping[str, float],
    pictures: Mapping[str, np.ndarray],
    renders: Mapping[str, np.ndarray],
    headers: Mapping[str, PhotoHeader],
) -> str:
    """Report the turn of all photos that makes renders match; empty if none does."""
    gains = _turn_gains(floor, pictures, renders)
    turn = max(gains, key=lambda tag: gains[tag])
    if gains[turn] < LEAST_GAIN:
        return ""
    finding = f"with the photos {TURNS[turn][0]} they are {gains[turn]:.1f} dB more so"
    if _median([float(headers[name].orientation == turn) for name in floor]) > 0:
        return f"{finding}: cameras are of the photos as their EXIF turns them; save them turned, without the tag"
    return f"{finding}: photos and cameras are turned to each other; take the photos that cameras were made of"


def _controls(name: str, pictures: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Select photos of other views, of the same shape, that a render is compared with."""
    same_shape = [view for view in pictures if view != name and pictures[view].shape == pictures[name].shape]
    return [pictures[view] for view in evenly_spaced(same_shape, CONTROLS)]


def _scaled_positions(floor: Mapping[str, float], pictures: Mapping[str, np.ndarray], scaled: _Scaled) -> str:
    """Report the scale of the cameras' positions that makes renders match; empty if none does."""
    gain, factor = scaled.best(floor, pictures, SCALES)
    if gain < LEAST_GAIN:
        return ""
    finding = f"with positions times about {factor:g} they are {gain:.1f} dB more so"
    return f"{finding}: cameras and splats are of other scales"


def _scaled_intrinsics(floor: Mapping[str, float], pictures: Mapping[str, np.ndarray], scaled: _Scaled) -> str:
    """Report the size of a picture whose intrinsics make renders match; empty if none does."""
    centred = intrinsics_factor([scaled.cameras[name] for name in floor])
    if centred is None or (gain := scaled.best(floor, pictures, [centred], intrinsics=True)[0]) < LEAST_GAIN:
        return ""
    return f"with intrinsics times {centred:.4g} they are {gain:.1f} dB more so: {intrinsics_advice(centred)}"


def _median(values: Sequence[float]) -> float:
    return float(np.median(values))


def _check_features(views: Views, files: Mapping[str, Path]) -> tuple[dict[str, float], list[str]]:
    """Measure features: medians over some views, and messages of what is wrong."""
    grids: list[np.ndarray] = []
    rows: list[list[float]] = []
    for name in evenly_spaced(views.views, VIEWS):
        observed = views[name]
        if isinstance(observed, FeatureGrid):
            grids.append(observed.grid.float().numpy())
        elif isinstance(observed, Regions) and name in files:
            labels = observed.labels[-1].numpy()
            size = (labels.shape[1], labels.shape[0])
            photo = _photo(files[name], size, size).mean(axis=2)
            rows.append([_edges(flipped, photo) for flipped in (labels, labels[:, ::-1], labels[::-1])])
    figures, wrong = {}, unlike_maps(grids)
    if grids:
        figures |= smoothness(grids)
    if rows:
        edges, *flipped = np.median(np.array(rows), axis=0).tolist()
        mirrored = max(flipped)
        figures |= {"edges": edges, "edges_of_mirrored": mirrored}
        if edges < LEAST_EDGES * mirrored and mirrored >= LEAST_BORDERS:
            finding = f"edges of photos are {edges:.2f} of the mean under the masks' borders"
            control = f"{mirrored:.2f} under mirrored ones"
            cause = "masks must be of these photos, upright, whole, not transposed"
            if mirrored >= LEAST_EDGES * edges:
                cause = f"the masks are {TURNS[2 if mirrored == flipped[0] else 4][0]}"
            wrong.append(f"features: {finding}, {control}: {cause}")
    return figures, wrong


def _fit_of_maps(views: Views, cameras: Cameras, files: Mapping[str, Path]) -> tuple[dict[str, float], list[str]]:
    """Measure by photos what was done to them, where maps have another shape: a figure a fit, and what is wrong."""
    names = [
        name
        for name in views.views
        if name in files and not views.is_regions(name) and cameras[name].lens is None
        and is_stretched(views.map_size(name), cameras[name].photo_size)
    ]  # fmt: skip
    if not names:
        return {}, []
    names = evenly_spaced(names, VIEWS)
    rows = [[_likeness(views.with_fit(fit), cameras[name], files[name]) for fit in FITS] for name in names]
    likeness = np.array(rows, np.float64)
    figures = {f"likeness_of_{fit}": _median(likeness[:, k].tolist()) for k, fit in enumerate(FITS)}
    assumed = FITS.index(views.fit(names[0]) or "stretch")
    best = int(np.argmax(np.median(likeness, axis=0)))
    gains = likeness[:, best] - likeness[:, assumed]
    if np.median(gains) < LEAST_LIKENESS_GAIN or (gains > 0).mean() < MOST_VIEWS:
        return figures, []
    finding = f"features: changes within maps follow the photos better ({figures[f'likeness_of_{FITS[best]}']:.2f}, "
    finding += f"not {figures[f'likeness_of_{FITS[assumed]}']:.2f}) if these were made by {FITS[best]}, not by"
    return figures, [
        f"{finding} {FITS[assumed]}: pack them with --map-fit {FITS[best]} (in Python FeatureGrid(map, "
        f"fit={FITS[best]!r}))"
    ]


def _likeness(views: Views, camera: Camera, file: Path) -> float:
    """Correlate the changes between neighbouring cells of a map with those of its photo's colours under them."""
    window = views.window(camera.name, camera)
    if window is not None and min(window.right - window.left, window.bottom - window.top) < 1:
        return 0.0  # no whole cell lies in the photo
    observed = views[camera.name]
    assert isinstance(observed, FeatureGrid)
    cells = torch.nn.functional.normalize(observed.grid.float(), dim=2).numpy()
    image, (width, height) = read_image(file, camera.photo_size)[0], camera.photo_size
    left, top, right, bottom = (0, 0, width, height) if window is None else window[2:]
    across, down = image.width / width, image.height / height
    box = left * across, top * down, right * across, bottom * down
    size = cells.shape[1], cells.shape[0]
    colours = np.asarray(image.resize(size, Image.Resampling.BOX, box=box), np.float32) / 255
    changes = [
        np.concatenate([np.linalg.norm(np.diff(values, axis=axis), axis=2).ravel() for axis in (0, 1)])
        for values in (cells, colours)
    ]
    has_changes = all(change.size and np.ptp(change) > 0 for change in changes)
    return float(np.corrcoef(np.stack(changes))[0, 1]) if has_changes else 0.0


def _edges(labels: np.ndarray, photo: np.ndarray) -> float:
    """Measure a photo's edges [h, w] where the labels [h, w] change, over the mean of all its edges."""
    down, across = np.abs(np.diff(photo, axis=0))[:, :-1], np.abs(np.diff(photo, axis=1))[:-1]
    strength = np.maximum(down, across)
    border = (labels[1:, :-1] != labels[:-1, :-1]) | (labels[:-1, 1:] != labels[:-1, :-1])
    return float(strength[border].mean() / max(strength.mean(), 1e-12)) if border.any() else 1.0


def _png(pixels: np.ndarray) -> bytes:
    content = io.BytesIO()
    Image.fromarray((255 * pixels).round().astype(np.uint8)).save(content, format="PNG")
    return content.getvalue()
