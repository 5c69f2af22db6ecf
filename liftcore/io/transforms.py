"""nerfstudio's files: cameras of a transforms.json or of its export, and the frame in which a run trained its splats.

The poses of both are camera-to-world with OpenGL axes. The intrinsics of a transforms.json are shared, or a frame's
own; where it has no size, that of each photo counts, as for Inria's code, nerfstudio and instant-ngp.

``ns-export cameras`` writes a list of ``file_path`` and ``transform`` [3, 4] (``transforms_train.json``), in the
frame of the exported splats; intrinsics are those of the transforms.json that the run was trained on.
"""

import math
from collections import ChainMap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.errors import InvalidCameras, InvalidInput, reading
from liftcore.io.colmap import PANORAMA, PINHOLES, Intrinsics, distortion_of
from liftcore.io.json_file import FORMATS, matrix, number, pixels, read_json
from liftcore.io.photos import PhotoHeader, PhotosBeside
from liftcore.scene.cameras import CAMERA_AXES, Camera, Cameras, InvalidPose, behind_lens, read_views, viewmat_of
from liftcore.scene.distortion import Distortion
from liftcore.scene.similarity import similarity_named
from liftcore.scene.views import cameras_of_views, view_names
from liftcore.scene.world import UNKNOWN, WorldFrame

FRAME_FILE = "dataparser_transforms.json"  # as nerfstudio names it, in the folder of a run
OWN_FRAME = (
    "poses of nerfstudio's own files: it trains in another frame than theirs, unless it was run with "
    f"--orientation-method none --center-method none --auto-scale-poses False. Put its run's {FRAME_FILE} beside them"
)
LEAST_UPRIGHT = 0.5  # cosine of the mean of the cameras' up axes with +Z
LEAST, LARGEST = 1e-9, 1e9  # scales
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
FISHEYE = "OPENCV_FISHEYE"
DISTORTION_ORDER = ("k1", "k2", "k3", "k4", "p1", "p2")  # nerfstudio's distortion_params
SUPPORTED_COEFFICIENTS = {
    True: ("k1", "k2", "k3", "k4"),
    False: ("k1", "k2", "k3", "p1", "p2"),
}  # of a fisheye, and of others
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
OTHER_LENSES = ("latlong", "equirectangular", "ftheta_p0", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4")
UNDISTORT = (
    "undistort the photos first (OpenCV does it, or 'colmap image_undistorter' where there is a COLMAP model), train "
    "and lift on them, and write their fl_x, fl_y, cx and cy without distortion"
)
OF_NERFSTUDIO = ("applied_transform", "ply_file_path")  # fields that only its own converter writes
EXPORTED = ("file_path", "transform")  # of each camera of an export
FOCALS = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")


def parse_transforms(document: Any, source: str, photos: PhotosBeside) -> Cameras:
    """Return the cameras of a transforms.json document, in the frame that its poses are in.

    A frame's own intrinsics come before the shared ones, and ``photos`` have missing sizes. A scene trained in
    another frame (nerfstudio normalises poses by default) must be exported together with its cameras.
    """
    with reading(source, InvalidCameras, FORMATS):
        names, frames = _named_frames(document["frames"])
    views = zip(names, [ChainMap(frame, document) for frame in frames], strict=True)
    cameras, warnings = read_views(views, lambda name, keys: _camera(name, keys, source, photos))
    of_nerfstudio = any(key in document for key in OF_NERFSTUDIO)
    warnings += [OWN_FRAME] if of_nerfstudio else []
    world = nerfstudio_world(cameras) if of_nerfstudio else UNKNOWN
    return Cameras(cameras, world=world, warnings=warnings)


def is_export(document: Any) -> bool:
    """Return True if a document has the form of nerfstudio's camera export."""
    records = document if isinstance(document, list) else []
    return bool(records) and all(isinstance(record, dict) and {*EXPORTED} <= record.keys() for record in records[:1])


def parse_export(records: Any, source: str, data: Any, photos: PhotosBeside) -> Cameras:
    """Return the cameras of nerfstudio's camera export, in the frame of its splats."""
    shared, frames = data if isinstance(data, dict) else {}, {}
    with reading(source, InvalidCameras, "a camera export"):
        names, poses = _named_frames(records)
        if isinstance(shared.get("frames"), list):
            frames = dict(zip(*_named_frames(shared["frames"]), strict=True))
        pairs = cameras_of_views(names, frames)
        scoped = []
        for name, record in zip(names, poses, strict=True):
            pose = {"transform_matrix": record.get("transform")}
            keys = ChainMap(pose, record, frames.get(pairs.get(name, ""), {}), shared)
            if not any(key in keys for key in FOCALS):
                got = (
                    f"none of {name!r}: this is nerfstudio's camera export (ns-export cameras), which has poses alone"
                )
                hint = "put the transforms.json of the data that nerfstudio was trained on beside it"
                raise ValueError(f"intrinsics in the file or beside it, got {got}; {hint}")
            scoped.append(keys)
    views = zip(names, scoped, strict=True)
    cameras, warnings = read_views(views, lambda name, keys: _camera(name, keys, source, photos))
    return Cameras(cameras, world=nerfstudio_world(cameras), warnings=warnings)


def _named_frames(frames: Any) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the names of views, and their records."""
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise ValueError(f"a list of objects as frames, got {repr(frames)[:60]}")
    paths = [frame["file_path"] for frame in frames]
    for path in paths:
        if not path or not isinstance(path, str):
            raise ValueError(f"the path of a photo as file_path, got {repr(path)[:60]}")
    return view_names(paths), frames


def nerfstudio_world(cameras: Sequence[Camera]) -> WorldFrame:
    """Return nerfstudio's convention, +Z up, unless its cameras contradict it; the unit is unknown.

    An ``applied_transform`` and an ``applied_scale`` lead back to the frame that the poses came in, mostly COLMAP's,
    of which neither is known. A run with the orientation method ``none`` keeps that frame's turn: then cameras stand
    across or upside down.
    """
    ups = np.array([-camera.viewmat[1, :3] for camera in cameras]).reshape(-1, 3)
    mean = ups.sum(axis=0)
    agrees = mean[2] >= LEAST_UPRIGHT * np.linalg.norm(mean) > 0
    return WorldFrame(up=(0.0, 0.0, 1.0)) if agrees else UNKNOWN


def transforms_of(cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """Return a transforms.json document of pinhole cameras; lenses of distorted photos are left out."""
    frames = []
    for name, camera in cameras.items():
        pose = np.linalg.inv(camera.viewmat)
        pose[:3, :3] *= CAMERA_AXES["opengl"]
        lens = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
        lens |= {"cx": camera.cx, "cy": camera.cy}
        frames.append({"file_path": f"{name}.png", "transform_matrix": pose.tolist(), **lens})
    return {"frames": frames}


def _camera(name: str, keys: ChainMap[str, Any], source: str, photos: PhotosBeside) -> Camera:
    """Return the view of a frame."""
    location = f"{source} frame {name!r}"
    with reading(location, InvalidCameras, "a camera"):
        distortion = _distortion(keys)
        width, height = _size(keys, photos)
        intrinsics = _intrinsics(keys, width, height)
    with reading(location, InvalidPose, "a pose"):
        pose = matrix(keys.get("transform_matrix"), (3, 4), 4, "transform_matrix")
    camera = Camera.pinhole(name, width, height, *intrinsics, viewmat=viewmat_of(pose, "opengl"))
    return behind_lens(camera, distortion)


def _size(keys: Mapping[str, Any], photos: PhotosBeside) -> tuple[int, int]:
    """Return width and height in pixels, of the frame or else of its photo."""
    if "w" in keys and "h" in keys:
        return pixels(keys["w"], "w"), pixels(keys["h"], "h")
    file_path, hint = str(keys["file_path"]), 'add the size of the photos as "w" and "h" at the top level of the file'
    try:
        header = photos.header(file_path)
    except InvalidInput as error:
        raise ValueError(f"an image size, w and h, or a photo, got {error.got} ({error.argument}); {hint}") from None
    if header is not None:
        return _size_of_photo(header, keys)
    got = f"none, and no photo {photos.missing(file_path)}"
    raise ValueError(f"an image size, w and h, got {got}; put the photos where file_path has them, or {hint}")


def _size_of_photo(header: PhotoHeader, keys: Mapping[str, Any]) -> tuple[int, int]:
    """Return the size of a photo as stored, or as EXIF rotates it if only that fits the principal point."""
    cx, cy = (number(keys[key], key) if key in keys else None for key in ("cx", "cy"))
    turns = cx is not None and cy is not None and cx > 0 < cy and header.turns_for((round(2 * cx), round(2 * cy)))
    width, height = header.oriented if turns else header.stored
    if (cx or 0) >= width or (cy or 0) >= height:
        expected = f"a principal point cx, cy within the photo of {width}x{height}"
        hint = 'the photo was made smaller: add "w" and "h" of the photos that the intrinsics are of at the top level'
        raise ValueError(f"{expected}, got {cx}, {cy}; {hint} of the file")
    return width, height


def _intrinsics(keys: Mapping[str, Any], width: int, height: int) -> Intrinsics:
    fx, fy = _focal(keys, "x", width), _focal(keys, "y", height)
    fx = fy if fx is None else fx
    fy = fx if fy is None else fy
    if fx is None or fy is None:
        raise ValueError("fl_x or camera_angle_x, got neither; add the focal length in pixels as fl_x and fl_y")
    return Intrinsics(fx, fy, number(keys.get("cx", width / 2), "cx"), number(keys.get("cy", height / 2), "cy"))


def _focal(keys: Mapping[str, Any], axis: str, side: int) -> float | None:
    length, of_view = f"fl_{axis}", f"camera_angle_{axis}"
    if length in keys:
        return number(keys[length], length)
    if of_view not in keys:
        return None
    angle = number(keys[of_view], of_view)
    if not 0 < angle < math.pi:
        raise ValueError(f"an angle in 0..pi as {of_view}, got {angle:g}")
    return 0.5 * side / math.tan(0.5 * angle)


def _distortion(keys: ChainMap[str, Any]) -> Distortion | None:
    """Return the distortion of a frame's photo; None where it has none."""
    model = keys.get("camera_model", "PINHOLE")
    other = next((key for scope in keys.maps for key in OTHER_LENSES if scope.get(key)), None)
    if model not in (*PERSPECTIVE, FISHEYE) or other:
        hint = PINHOLES if model == PANORAMA or other in ("equirectangular", "latlong") else UNDISTORT
        raise ValueError(f"a perspective camera or {FISHEYE}, got {other or repr(model)[:60]}; {hint}")
    fisheye = model == FISHEYE or bool(keys.get("is_fisheye"))
    sets = [values for scope in keys.maps for values in _coefficients(scope)]
    if any(values != sets[0] for values in sets):  # programs differ in which of them counts
        texts = (", ".join(f"{key} = {value:g}" for key, value in values.items()) or "none" for values in sets)
        alternatives = " and ".join(texts)
        raise ValueError(f"the same distortion wherever it is given, got {alternatives}")
    values = sets[0] if sets else {}
    unread = next((key for key in values if key not in SUPPORTED_COEFFICIENTS[fisheye]), None)
    if unread:
        kind = "a fisheye" if fisheye else "a perspective camera"
        expected = f"{', '.join(SUPPORTED_COEFFICIENTS[fisheye])} alone of {kind}"
        raise ValueError(f"{expected}, got {unread} = {values[unread]:g}; {UNDISTORT}")
    return distortion_of(values, fisheye=fisheye)


def _coefficients(scope: Mapping[str, Any]) -> list[dict[str, float]]:
    """Return the parameters of a frame or of all frames by name, without zeros: of a list, and of single ones."""
    params = scope.get("distortion_params") or []
    if not isinstance(params, list) or len(params) not in (0, len(DISTORTION_ORDER)):
        expected = f"distortion_params, a list of the {len(DISTORTION_ORDER)} numbers {', '.join(DISTORTION_ORDER)}"
        raise ValueError(f"{expected}, got {repr(params)[:60]}")
    of_list: dict[str, Any] = dict(zip(DISTORTION_ORDER, params, strict=False))
    sets = of_list, {key: scope[key] for key in DISTORTION if key in scope}
    return [{key: x for key in values if (x := number(values[key], key)) != 0} for values in sets if values]


def cameras_in_frame(cameras: Cameras, matrix: np.ndarray) -> Cameras:
    """Return the cameras in the frame of the splats, of `read_frame`."""
    views = [camera.transformed(matrix) for camera in cameras.values()]
    warnings = [warning for warning in cameras.warnings if warning != OWN_FRAME]
    return Cameras(views, frame=FRAME_FILE, world=nerfstudio_world(views), warnings=warnings)


def read_frame(path: Path, applied: Mapping[str, Any], source: str) -> np.ndarray:
    """Return the similarity [4, 4] f64 from the frame of camera files to that of the splats.

    The file holds ``transform`` T [3, 4] and ``scale`` s, which take the frame of the COLMAP model to that of the
    splats. Poses of a transforms.json are transformed already, by its ``applied_transform`` A and
    ``applied_scale`` a. The rest is ``(s / a) T A^-1``, as in nerfstudio's data parser.

    Args:
        applied: the transforms.json ``source`` that the cameras are of; empty of a COLMAP model.
    """
    document = read_json(path)
    with reading(path, InvalidCameras, "the frame of a run"):
        transform, scale = _affine(document["transform"], "transform"), _scale(document["scale"], "scale")
    with reading(source, InvalidCameras, "a transforms.json"):
        before = np.eye(4)
        if applied.get("applied_transform") is not None:
            before = _affine(applied["applied_transform"], "applied_transform")
            similarity_named("applied_transform", before)
        combined = transform @ np.linalg.inv(before)
        combined[:3] *= scale / _scale(applied.get("applied_scale", 1.0), "applied_scale")
    with reading(path, InvalidCameras, "the frame of a run"):
        similarity_named("transform", combined)
    return combined


def _affine(value: Any, name: str) -> np.ndarray:
    affine = np.eye(4)
    affine[:3] = matrix(value, (3, 4), 4, name)[:3]
    return affine


def _scale(value: Any, name: str) -> float:
    scale = number(value, name)
    if not LEAST <= scale <= LARGEST:
        raise ValueError(f"a scale in {LEAST:g}..{LARGEST:g} as {name}, got {scale:g}")
    return scale
