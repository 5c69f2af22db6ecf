"""Do splats, cameras, photos and features belong together? What is wrong is told before the work.

Nothing here knows how good a scene is. Each measure has its own control: a render is held against other views' photos
too, the edges of masks against the same masks mirrored, and features as `lifting.planning.contradictions` has it.

Photos of another shape than their cameras are told by their headers alone, and compared no further. Where renders are
not like their photos, the causes that photos can show are tried: photos that are turned or mirrored, photos that are
shifted (a principal point that is off), photos of another exposure, positions in another scale. One is named where it
makes renders like their photos; where none does, nothing is blamed.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from liftcore.features.encoders.encode import TURNS, find_images, read_image, readings_of
from liftcore.features.smoothness import smoothness, unlike_maps
from liftcore.io.cameras import read_cameras
from liftcore.io.photos import PhotoHeader, orientation_warnings, read_header
from liftcore.io.remote import local_path
from liftcore.io.splats import read_splats
from liftcore.lifting.planning.contradictions import (
    FAR_SCALES,
    LEAST_IN_VIEW,
    LEAST_ROW_SUM,
    NEAR_SCALES,
    agreement_of_views,
    disagreement,
    empty,
    unseen,
)
from liftcore.lifting.planning.views import visibility
from liftcore.query.splat_colours import view_colours
from liftcore.raster import open_raster
from liftcore.raster.base import Raster
from liftcore.runtime.arguments import as_list
from liftcore.runtime.device import CPU
from liftcore.runtime.progress import Progress, shown_progress
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.drawing import in_photo
from liftcore.scene.panorama import with_panoramas
from liftcore.scene.render_mode import rendering_reason, rendering_warnings
from liftcore.scene.splats import Splats
from liftcore.scene.views import cameras_of_views, first_names
from liftcore.solve.diagnostics import is_stretched, shape_warnings
from liftcore.values.lens import photo_as_pinhole_sees
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import Views, pair, read_features
from liftcore.values.settings import LiftSettings
from liftcore.values.views import FeatureGrid, Regions

VIEWS = 12  # that are looked at, evenly spread
CONTROLS = 3  # other photos that a render is held against
LEAST_GAIN = 3.0  # dB, of a render over other views' photos to its own
LEAST_SHIFT = 2.0  # pixels, beyond what a pinhole's rounding and a lens leave
SCALED_VIEWS = 4  # that are rendered anew for each scale
LEAST_EDGES = 1.1  # of the photo's edges under masks, over those under mirrored ones


HOW_TURNED = {  # by EXIF's orientation
    2: "mirrored left to right", 3: "turned by 180 degrees", 4: "mirrored upside down", 5: "transposed",
    6: "turned by 90 degrees clockwise", 7: "transposed across", 8: "turned by 90 degrees counterclockwise",
}  # fmt: skip


@dataclass(frozen=True)
class ViewCheck:
    """A view beside its photo."""

    view: str
    row_sum: float  # the mean of A 1
    psnr: float | None  # dB, of the render to the photo; None without a photo or colours
    other_psnr: float | None  # dB, the mean to other views' photos


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
    splats: Splats | Path | str,
    cameras: Cameras | Path | str,
    photos: Mapping[str, Path | str] | Path | str | Sequence[Path | str] | None = None,
    features: Views | Path | str | Sequence[Path | str] | None = None,
    progress: Progress | bool | None = False,
    settings: LiftSettings | None = None,
) -> CheckReport:
    """Render some views and hold them against what is known of them.

    Args:
        splats, cameras: or where they lie, as `read_splats` and `read_cameras` take them.
        photos: view -> image; or images and folders of them. features: of the views; or the paths of feature packs.
        progress: as `liftcore.lift` has it; told about a stage "check", in views.
        settings: of the lift that is to come; its ``antialiased`` counts. None: the default ones.

    Raises:
        InvalidInput: an image that cannot be read. InvalidFeatures: features that cannot be read.
        InvalidSplats, InvalidCameras: as readers of splats and cameras have it.
    """
    settings = LiftSettings.or_default(settings)
    features = features if features is None or isinstance(features, Views) else read_features(*as_list(features))
    if isinstance(photos, Mapping):
        images = {view: local_path(file, "photos") for view, file in photos.items()}
    else:
        images = find_images(photos or ())
    splats = splats if isinstance(splats, Splats) else read_splats(splats, settings.kernel)
    if not isinstance(cameras, Cameras):
        cameras = read_cameras(cameras, views=features.views if features is not None else list(images))
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
    contradicting = rendering_warnings(splats.render_mode, trained.antialiased, splats.kernel)
    notes = [f"splats: {text}" for text in (*contradicting, *splats.warnings)]
    notes += [f"cameras: {text}" for text in cameras.warnings]
    if trained.antialiased:
        notes.append(f"splats: rendered antialiased: {rendering_reason(splats.render_mode, True)}")
    files, whole = _paired_photos(photos, cameras, features is not None, wrong, notes)
    sizes = {name: _photo_of(cameras[name], whole[name]) for name in files}
    headers = {name: read_header(file) for name, file in files.items()}
    notes += [f"photos: {line}" for line in orientation_warnings(readings_of(headers, sizes), "their cameras")]
    odd, told = _other_shapes(headers, sizes)
    wrong += told
    alike = {name: file for name, file in files.items() if name not in odd}
    names = evenly_spaced(list(alike) or list(cameras), VIEWS)
    shown = [name for name in names if name in alike]
    pictures = {name: _photo(files[name], sizes[name], cameras[name].photo_size, whole[name]) for name in shown}
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
    wrong += _wrong_cameras(views, in_view)
    wrong += _unlike_photos(views, pictures, renders, headers, _Scaled(raster, splats, cameras, trained, background))
    figures: dict[str, float] = {}
    if features is not None:
        figures, told = _check_features(features, cameras, files, whole)
        paired_features = pair(features, cameras)[0]
        notes += [
            f"features: {text}"
            for text in shape_warnings(paired_features, [cameras[v] for v in paired_features.views])
        ]
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


def _paired_photos(
    photos: Mapping[str, Path], cameras: Cameras, featured: bool, wrong: list[str], notes: list[str]
) -> tuple[dict[str, Path], dict[str, Camera | None]]:
    """Camera -> its photo, and the camera itself where it is a face of a panorama that the photo is; None elsewhere.

    Args:
        featured: whether there are features. wrong, notes: take what photos and cameras say of each other.
    """
    paired = cameras_of_views(photos, with_panoramas(cameras))
    taken = {name: photos[view] for view, name in paired.items()}
    faces = {name: camera.face.photo for name, camera in cameras.items() if camera.face is not None}
    files = {name: taken[photo] for name, photo in faces.items() if photo in taken and name not in taken}
    panoramas = frozenset(files)  # of which a file is the panorama, and not the camera's own photo
    files |= {name: file for name, file in taken.items() if name in cameras}
    if not photos:
        what = "so the features alone tell" if featured else "so nothing tells"
        notes.append(f"photos: none were given, {what} whether these cameras are those of the splats")
    elif not files:
        named = f"{first_names(photos)}, but the cameras {first_names(cameras)}"
        wrong.append(f"photos: none is named as a camera: the photos are {named}")
    else:
        bare, lost = [name for name in cameras if name not in files], [name for name in photos if name not in paired]
        notes += [f"photos: {len(bare)} cameras have none: {first_names(bare)}"] if bare else []
        notes += [f"photos: {len(lost)} have no camera: {first_names(lost)}"] if lost else []
    return files, {name: cameras[name] if name in panoramas else None for name in files}


def evenly_spaced(names: Sequence[str], count: int) -> list[str]:
    """As many of the names, evenly spread."""
    places = np.linspace(0, len(names) - 1, min(count, len(names))).round()
    return [names[int(place)] for place in places]


def _render(
    raster: Raster, splats: Splats, camera: Camera, params: CompositingParams
) -> tuple[np.ndarray, np.ndarray]:
    """A view over black [H, W, 3] f32 in the pixels of its photo, and what splats leave of each ray [H, W, 1] f32."""
    values = torch.cat([view_colours(splats, camera), torch.ones(splats.count, 1, dtype=torch.float32)], dim=1)
    image = in_photo(camera, lambda of: raster.render(of, values, params)).numpy()
    return image[..., :3], 1.0 - image[..., 3:]


def _background(
    renders: Mapping[str, np.ndarray], unfilled: Mapping[str, np.ndarray], pictures: Mapping[str, np.ndarray]
) -> float:
    """White (1) where it makes renders more like their photos, as captures without a background have; else 0."""
    gains = [
        _psnr((renders[name] + unfilled[name]).clip(0, 1), photo) - _psnr(renders[name].clip(0, 1), photo)
        for name, photo in pictures.items()
        if photo.shape == renders[name].shape
    ]
    return float(bool(gains) and _median(gains) > 0)


def _photo_of(camera: Camera, panorama: Camera | None) -> tuple[int, int]:
    """Width and height of the photo that a camera is of; of a ``panorama`` that camera, a face, of the whole one."""
    face = None if panorama is None else panorama.face
    return camera.photo_size if face is None else (face.width, face.height)


def _other_shapes(
    headers: Mapping[str, PhotoHeader], sizes: Mapping[str, tuple[int, int]]
) -> tuple[set[str], list[str]]:
    """The views whose photos no scale makes as large as their cameras say, and a sentence for each kind of them."""
    across, others = [], []
    for name, header in headers.items():
        size = header.oriented if header.turns_for(sizes[name]) else header.stored
        if not is_stretched(size, sizes[name]):
            continue
        (across if not is_stretched((size[1], size[0]), sizes[name]) else others).append(name)
    advice = {
        "lie on their side ({}): take the photos as they were when their cameras were made": across,
        "are of another shape than their cameras ({}): crops or other photos": others,
    }
    shapes = {
        name: "{}x{} for a camera of {}x{}".format(*headers[name].stored, *sizes[name]) for name in across + others
    }
    return {*across, *others}, [
        f"photos: {len(found)} of {len(headers)} {text.format(f'{found[0]} is {shapes[found[0]]}')}"
        for text, found in advice.items()
        if found
    ]


def _photo(path: Path, like: tuple[int, int], size: tuple[int, int], panorama: Camera | None) -> np.ndarray:
    """[H, W, 3] f32 in 0..1, a photo in a size (width, height); of a ``panorama`` what that camera, a face, sees.

    Args:
        like: width and height of what tells the photo's orientation.
    """
    image = read_image(path, like)[0]
    if panorama is not None and panorama.face is not None:
        whole = image.resize((panorama.face.width, panorama.face.height), Image.Resampling.BOX)
        image = Image.fromarray(photo_as_pinhole_sees(np.asarray(whole), panorama))
    return np.asarray(image.resize(size, Image.Resampling.BOX), np.float32) / 255


def _against(name: str, row_sum: float, render: np.ndarray | None, pictures: Mapping[str, np.ndarray]) -> ViewCheck:
    if render is None or name not in pictures:
        return ViewCheck(name, row_sum, None, None)
    controls = [_psnr(render, photo) for photo in _controls(name, pictures)]
    return ViewCheck(name, row_sum, _psnr(render, pictures[name]), float(np.mean(controls)) if controls else None)


def _psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.square(one - other, dtype=np.float64).mean(), 1e-10)))


def _wrong_cameras(views: Sequence[ViewCheck], in_view: float) -> list[str]:
    wrong, row_sum = [], float(np.median([view.row_sum for view in views]))
    if row_sum < LEAST_ROW_SUM:
        wrong.append(empty(row_sum))
    if in_view < LEAST_IN_VIEW:
        wrong.append(unseen(in_view))
    return wrong


@dataclass(frozen=True)
class _Scaled:
    """Renders of a scene with its cameras' positions times a factor."""

    raster: Raster
    splats: Splats
    cameras: Cameras
    params: CompositingParams
    background: float  # 0, black, or 1, white

    def render(self, view: str, factor: float) -> np.ndarray:
        """[H, W, 3] f32 in 0..1, of a view."""
        camera, scale = self.cameras[view], np.ones((4, 4))
        scale[:3, 3] = factor
        moved = camera.replace(viewmat=camera.viewmat * scale)
        render, unfilled = _render(self.raster, self.splats, moved, self.params)
        return (render + self.background * unfilled).clip(0.0, 1.0)


def _unlike_photos(
    views: Sequence[ViewCheck],
    pictures: Mapping[str, np.ndarray],
    renders: Mapping[str, np.ndarray],
    headers: Mapping[str, PhotoHeader],
    scaled: _Scaled,
) -> list[str]:
    """That renders are not like their photos, if so, and the cause that makes them alike, if one does."""
    compared = {
        view.view: (view.psnr, view.other_psnr)
        for view in views
        if view.psnr is not None and view.other_psnr is not None
    }
    if not compared:
        return []
    if _median([own - other for own, other in compared.values()]) >= LEAST_GAIN:
        return _some_turned(compared, pictures, renders)
    own = {name: psnr for name, (psnr, _) in compared.items()}
    gain = _median([psnr - other for psnr, other in compared.values()])
    told = f"photos: renders are hardly more like their own photos ({_median(list(own.values())):.1f} dB)"
    told = f"{told} than like other views' ({gain:+.1f} dB)"
    floor = {name: max(compared[name]) for name in own}
    cause = (
        _turned_photos(floor, pictures, renders, headers)
        or _shifted_photos(floor, pictures, renders)
        or _exposed_photos(floor, pictures, renders)
        or _scaled_positions(floor, pictures, scaled)
    )
    unknown = "splats, cameras and photos are not of one scene in one frame, or photos and cameras not of each other"
    return [f"{told}; {cause or unknown}"]


def _some_turned(
    compared: Mapping[str, tuple[float, float]], pictures: Mapping[str, np.ndarray], renders: Mapping[str, np.ndarray]
) -> list[str]:
    """A sentence for each turn that makes single photos like their renders, among others that are like them."""
    turned: dict[int, list[str]] = {}
    for name, (own, other) in compared.items():
        if own - other >= LEAST_GAIN:
            continue
        ways = {tag: np.asarray(_turn(pictures[name], way)) for tag, way in TURNS.items()}
        gains = {
            tag: _psnr(renders[name], picture) - max(own, other)
            for tag, picture in ways.items()
            if picture.shape == renders[name].shape
        }
        best = max(gains, key=lambda tag: gains[tag])
        if gains[best] >= LEAST_GAIN:
            turned.setdefault(best, []).append(name)
    return [
        f"photos: {len(names)} of the {len(compared)} compared ({first_names(names)}) are {HOW_TURNED[tag]}: "
        "take the photos that cameras were made of"
        for tag, names in sorted(turned.items())
    ]


def _turned_photos(
    floor: Mapping[str, float],
    pictures: Mapping[str, np.ndarray],
    renders: Mapping[str, np.ndarray],
    headers: Mapping[str, PhotoHeader],
) -> str:
    """The turn of the photos that makes renders like them; empty where none does."""
    best, turn = 0.0, 0
    for tag, way in TURNS.items():
        turned = {name: np.asarray(_turn(pictures[name], way)) for name in floor}
        found = [
            _psnr(renders[name], turned[name]) - floor[name]
            for name in floor
            if turned[name].shape == renders[name].shape
        ]
        if found and _median(found) > best:
            best, turn = _median(found), tag
    if best < LEAST_GAIN:
        return ""
    how = f"with the photos {HOW_TURNED[turn]} they are {best:.1f} dB more so"
    if _median([float(headers[name].orientation == turn) for name in floor]) > 0:
        return f"{how}: cameras are of the photos as their EXIF turns them; save them turned, without the tag"
    return f"{how}: photos and cameras are turned to each other; take the photos that cameras were made of"


def _turn(picture: np.ndarray, way: Image.Transpose) -> np.ndarray:
    """A picture [H, W, 3] turned as Pillow has it."""
    flips = {
        Image.Transpose.FLIP_LEFT_RIGHT: lambda image: image[:, ::-1],
        Image.Transpose.FLIP_TOP_BOTTOM: lambda image: image[::-1],
        Image.Transpose.ROTATE_180: lambda image: image[::-1, ::-1],
        Image.Transpose.TRANSPOSE: lambda image: image.swapaxes(0, 1),
        Image.Transpose.TRANSVERSE: lambda image: image[::-1, ::-1].swapaxes(0, 1),
        Image.Transpose.ROTATE_90: np.rot90,
        Image.Transpose.ROTATE_270: lambda image: np.rot90(image, 3),
    }
    return flips[way](picture)


def _shifted_photos(
    floor: Mapping[str, float], pictures: Mapping[str, np.ndarray], renders: Mapping[str, np.ndarray]
) -> str:
    """The shift of the photos by which renders are like them; empty where none is."""
    shifts = np.array([_shift(pictures[name], renders[name]) for name in floor])
    down, across = np.median(shifts, axis=0)
    if max(abs(down), abs(across)) < LEAST_SHIFT:
        return ""
    gains = []
    for name, least in floor.items():
        photo, render = _overlap(pictures[name], renders[name], int(down), int(across))
        gains.append(_psnr(photo, render) - least if photo.size else -np.inf)
    if _median(gains) < LEAST_GAIN:
        return ""
    return (
        f"with the photos shifted by about {across:g} pixels across and {down:g} down they are "
        f"{_median(gains):.1f} dB more so: principal points (cx, cy) are off, or photos were cropped"
    )


def _shift(photo: np.ndarray, render: np.ndarray) -> tuple[int, int]:
    """The shift (down, across) in pixels of a photo that lies best on a render, by phase correlation."""
    one, other = (np.fft.rfft2(image.mean(axis=2) - image.mean()) for image in (render, photo))
    cross = one * other.conj()
    peaks = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-12), s=render.shape[:2])
    place = np.unravel_index(int(peaks.argmax()), peaks.shape)
    down, across = (
        int(at) - side if at > side // 2 else int(at) for at, side in zip(place, peaks.shape, strict=True)
    )
    return down, across


def _overlap(photo: np.ndarray, render: np.ndarray, down: int, across: int) -> tuple[np.ndarray, np.ndarray]:
    """What a photo that is shifted and a render both show."""
    height, width = render.shape[:2]
    here = np.s_[max(0, down) : height + min(0, down), max(0, across) : width + min(0, across)]
    there = np.s_[max(0, -down) : height - max(0, down), max(0, -across) : width - max(0, across)]
    return photo[there], render[here]


def _exposed_photos(
    floor: Mapping[str, float], pictures: Mapping[str, np.ndarray], renders: Mapping[str, np.ndarray]
) -> str:
    """The change of the renders' colours by which they are like their photos; empty where none is.

    Any colours become like any photo's to some degree, so other views' photos are the control here too.
    """
    gains, factors = [], []
    for name, least in floor.items():
        changed, factor = _in_colours_of(renders[name], pictures[name])
        others = _controls(name, pictures)
        control = [_psnr(_in_colours_of(renders[name], photo)[0], photo) for photo in others]
        gains.append(_psnr(changed, pictures[name]) - max(least, *control))
        factors.append(factor)
    if _median(gains) < LEAST_GAIN:
        return ""
    return (
        f"with their colours times about {_median(factors):.2g} they are {_median(gains):.1f} dB more so: the photos "
        "are of another exposure or development than those that the splats were trained on"
    )


def _in_colours_of(render: np.ndarray, photo: np.ndarray) -> tuple[np.ndarray, float]:
    """A render [H, W, 3] f32 with the factor and the offset of each channel that fit a photo, and the mean factor."""
    centred = render - render.mean(axis=(0, 1))
    factors = (centred * photo).mean(axis=(0, 1)) / np.maximum(np.square(centred).mean(axis=(0, 1)), 1e-12)
    return photo.mean(axis=(0, 1)) + factors * centred, float(factors.mean())


def _controls(name: str, pictures: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Photos of other views that a render is held against, of the shape of its own."""
    alike = [view for view in pictures if view != name and pictures[view].shape == pictures[name].shape]
    return [pictures[view] for view in evenly_spaced(alike, CONTROLS)]


def _scaled_positions(floor: Mapping[str, float], pictures: Mapping[str, np.ndarray], scaled: _Scaled) -> str:
    """The scale of the cameras' positions by which renders are like the photos; empty where none is."""
    names, best, scale = evenly_spaced(list(floor), SCALED_VIEWS), 0.0, 1.0
    for factor in (*NEAR_SCALES, *FAR_SCALES):
        gains = []
        for name in names:
            render = scaled.render(name, factor)
            control = [_psnr(render, photo) for photo in _controls(name, pictures)]
            gains.append(_psnr(render, pictures[name]) - max(floor[name], *control))
        if _median(gains) > best:
            best, scale = _median(gains), factor
    if best < LEAST_GAIN:
        return ""
    return (
        f"with positions times about {scale:g} they are {best:.1f} dB more so: cameras and splats are of other scales"
    )


def _median(values: Sequence[float]) -> float:
    return float(np.median(values))


def _check_features(
    features: Views, cameras: Cameras, files: Mapping[str, Path], whole: Mapping[str, Camera | None]
) -> tuple[dict[str, float], list[str]]:
    """Medians over some views, and what is wrong by them."""
    views = pair(features, cameras)[0]
    grids: list[np.ndarray] = []
    rows: list[tuple[float, float]] = []
    for name in evenly_spaced(views.views, VIEWS):
        observed = views[name]
        if isinstance(observed, FeatureGrid):
            grids.append(observed.grid.float().numpy())
        elif isinstance(observed, Regions) and name in files:
            labels = observed.labels[-1].numpy()
            size = (labels.shape[1], labels.shape[0])
            photo = _photo(files[name], size, size, whole[name]).mean(axis=2)
            mirrored = max(_edges(labels[:, ::-1], photo), _edges(labels[::-1], photo))
            rows.append((_edges(labels, photo), mirrored))
    figures, wrong = {}, unlike_maps(grids)
    if grids:
        found = smoothness(grids)
        figures |= {"neighbouring_cells": found.neighbours, "any_two_cells": found.all_pairs, **found.readings}
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
