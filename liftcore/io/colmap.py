"""COLMAP sparse models, binary and text: cameras and poses; the points are not read."""

import mmap
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from liftcore.errors import InvalidCameras, naming, reading
from liftcore.io.files import open_regular, refuse_pointer
from liftcore.scene.cameras import Camera, Cameras, InvalidPose, behind_lens, read_views
from liftcore.scene.distortion import Brown, Distortion, Fisheye
from liftcore.scene.quaternions import rotation_matrices
from liftcore.scene.views import REPLACED, view_names

MAX_TEXT_LINE = 64 * 1024 * 1024  # bytes; a line of an image's points runs to a few MB
MAX_NAME_BYTES = 4096
POINT_BYTES = 24  # x, y and the id of its 3D point
MODEL_FILES = ("cameras.bin", "cameras.txt", "images.bin", "images.txt")


UNDISTORT = "undistort the photos first, with 'colmap image_undistorter', and train and lift on its output"


class Intrinsics(NamedTuple):
    """A pinhole: focal lengths and principal point in pixels, from the top left corner of the image."""

    fx: float
    fy: float
    cx: float
    cy: float


class CameraModel(NamedTuple):
    """A camera model: its name, how many parameters are focal lengths, and which follow the principal point."""

    name: str
    parameters: int
    focals: int
    distortion: tuple[str, ...] | None  # the names of the distortion's parameters; None: a model without a pinhole
    fisheye: bool = False


# By COLMAP's model id (src/colmap/sensor/models.h).
COLMAP_MODELS = (
    CameraModel("SIMPLE_PINHOLE", 3, 1, ()),
    CameraModel("PINHOLE", 4, 2, ()),
    CameraModel("SIMPLE_RADIAL", 4, 1, ("k1",)),
    CameraModel("RADIAL", 5, 1, ("k1", "k2")),
    CameraModel("OPENCV", 8, 2, ("k1", "k2", "p1", "p2")),
    CameraModel("OPENCV_FISHEYE", 8, 2, ("k1", "k2", "k3", "k4"), fisheye=True),
    CameraModel("FULL_OPENCV", 12, 2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    CameraModel("FOV", 5, 2, None),
    CameraModel("SIMPLE_RADIAL_FISHEYE", 4, 1, ("k1",), fisheye=True),
    CameraModel("RADIAL_FISHEYE", 5, 1, ("k1", "k2"), fisheye=True),
    CameraModel("THIN_PRISM_FISHEYE", 12, 2, None),
    CameraModel("RAD_TAN_THIN_PRISM_FISHEYE", 16, 2, None),
    CameraModel("SIMPLE_DIVISION", 4, 1, None),
    CameraModel("DIVISION", 5, 2, None),
    CameraModel("SIMPLE_FISHEYE", 3, 1, (), fisheye=True),
    CameraModel("FISHEYE", 4, 2, (), fisheye=True),
    CameraModel("EUCM", 6, 2, None),
    CameraModel("EQUIRECTANGULAR", 2, 0, None),
)
MODELS_BY_NAME = {model.name: model for model in COLMAP_MODELS}
PANORAMA = "EQUIRECTANGULAR"
PINHOLES = (
    "a panorama is no picture of a pinhole: make pinhole photos of it, with nerfstudio's ns-process-data "
    "--camera-type equirectangular or COLMAP's panorama_sfm.py, and train and lift on those"
)
READ_MODELS = ", ".join(model.name for model in COLMAP_MODELS if model.distortion is not None)


@dataclass(frozen=True)
class _Sensor:
    width: int
    height: int
    model: CameraModel
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class _Image:
    name: str
    camera: int
    quaternion: tuple[float, ...]  # w x y z, world to camera
    translation: tuple[float, ...]


def has_model(folder: Path) -> bool:
    """Return True if the folder itself has a file of a sparse model."""
    return any((folder / name).is_file() for name in MODEL_FILES)


def is_whole(folder: Path) -> bool:
    """Return True if the folder itself has both files of a sparse model."""
    return all(path.is_file() for path in model_files(folder))


def model_files(folder: Path) -> list[Path]:
    """Return the files of cameras and images: a complete pair if there is one, binary before text, as in COLMAP."""
    kinds = [[folder / f"cameras.{kind}", folder / f"images.{kind}"] for kind in ("bin", "txt")]
    return max(kinds, key=lambda files: sum(path.is_file() for path in files))


def read_colmap(folder: Path) -> Cameras:
    """Read the cameras of a sparse model, by image name."""
    camera_file, image_file = model_files(folder)
    for path in (camera_file, image_file):
        if not path.is_file():
            raise InvalidCameras(str(folder), expected=f"the file {path.name}", got="a folder without it")
    with _reading(camera_file):
        sensors = dict((_binary_sensors if camera_file.suffix == ".bin" else _text_sensors)(camera_file))
    images = _read_images(image_file)
    with naming(folder):
        names = view_names([image.name for image in images])
        files = camera_file, image_file
        pairs = zip(names, images, strict=True)
        cameras, warnings = read_views(pairs, lambda name, image: _camera(name, image, sensors, files))
        broken = [name for name in names if REPLACED in name]
        if broken:
            advice = "views pair with none of them: rename the photos, and their names in the model"
            warnings.append(f"the names of {len(broken)} images are not UTF-8, such as {broken[0]!r}; {advice}")
        return Cameras(cameras, warnings=warnings)


def read_image_names(folder: Path) -> list[str]:
    """Read the names of a sparse model's views, without their cameras."""
    return view_names([image.name for image in _read_images(model_files(folder)[1])])


def _read_images(path: Path) -> list[_Image]:
    with _reading(path):
        return list((_binary_images if path.suffix == ".bin" else _text_images)(path))


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    with reading(path, InvalidCameras, "a file of a sparse model", "export the sparse model again"):
        with open_regular(path) as handle:
            refuse_pointer(str(path), handle.read(64))
        try:
            yield
        except struct.error:
            raise ValueError(f"a whole file, got one that ends after {path.stat().st_size} bytes") from None


def _camera(name: str, image: _Image, sensors: Mapping[int, _Sensor], files: tuple[Path, Path]) -> Camera:
    """Return the view of an image; cameras that no image uses may be of any model."""
    sensor, source = sensors.get(image.camera), str(files[1])
    if sensor is None:
        raise InvalidCameras(source, expected="images of known cameras", got=f"{name!r} of camera {image.camera}")
    pose = np.eye(4)
    if not np.isfinite(image.quaternion).all() or not any(image.quaternion):
        expected, got = "a finite quaternion that is not zero", str(list(image.quaternion))
        raise InvalidPose(f"{source} image {name!r}", expected=expected, got=got)
    pose[:3, :3] = rotation_matrices(np.array(image.quaternion))
    pose[:3, 3] = image.translation
    with reading(f"{files[0]} camera {image.camera}", InvalidCameras, f"a camera of {READ_MODELS}"):
        intrinsics, distortion = calibration(sensor.model, sensor.parameters)
    camera = Camera.pinhole(name, sensor.width, sensor.height, *intrinsics, viewmat=pose)
    return behind_lens(camera, distortion)


def _mapped(path: Path) -> Any:
    """Map a binary file, whose points are passed over."""
    with path.open("rb") as handle:
        is_empty = not handle.seek(0, 2)  # which cannot be mapped
        data: Any = b"" if is_empty else mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ)
    return data


def _row_count(data: Any) -> int:
    (count,) = struct.unpack_from("<Q", data)
    if count > len(data):
        raise ValueError(f"no more rows than the file has bytes, {len(data)}, got {count}")
    return count


def _binary_sensors(path: Path) -> Iterator[tuple[int, _Sensor]]:
    data, offset = _mapped(path), 8
    for _ in range(_row_count(data)):
        number, model, width, height = struct.unpack_from("<IiQQ", data, offset)
        if not 0 <= model < len(COLMAP_MODELS):
            raise ValueError(f"a camera of {READ_MODELS}, got camera model id {model}; {UNDISTORT}")
        parameters = struct.unpack_from(f"<{COLMAP_MODELS[model].parameters}d", data, offset + 24)
        offset += 24 + 8 * len(parameters)
        yield number, _Sensor(width, height, COLMAP_MODELS[model], parameters)


def _binary_images(path: Path) -> Iterator[_Image]:
    data, offset = _mapped(path), 8
    for _ in range(_row_count(data)):
        _, *pose, camera = struct.unpack_from("<I7dI", data, offset)
        end = data.find(b"\0", offset + 64, offset + 64 + MAX_NAME_BYTES)
        if end < 0:
            raise ValueError("an image name that ends, got none")
        name = bytes(data[offset + 64 : end]).decode("utf-8", errors="replace")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + points * POINT_BYTES
        if offset > len(data):
            raise ValueError(f"{points} points of {name!r}, got a file that ends after {len(data)} bytes")
        yield _Image(name, camera, tuple(pose[:4]), tuple(pose[4:]))


def _text_lines(path: Path) -> Iterator[str]:
    with path.open("rb") as handle:
        while line := handle.readline(MAX_TEXT_LINE):
            if len(line) == MAX_TEXT_LINE:
                raise ValueError(f"lines under {MAX_TEXT_LINE} bytes, got a longer one")
            yield line.decode("utf-8", errors="replace").strip().lstrip("\ufeff")


def _text_sensors(path: Path) -> Iterator[tuple[int, _Sensor]]:
    for line in _text_lines(path):
        if not line or line.startswith("#"):
            continue
        try:
            number, model, width, height, *values = line.split()
            parameters = tuple(float(value) for value in values)
            camera, size = int(number), (int(width), int(height))
        except ValueError:
            raise _bad_line("CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", line) from None
        unknown = CameraModel(model[:60], len(parameters), 0, None)
        yield camera, _Sensor(*size, MODELS_BY_NAME.get(model, unknown), parameters)


def _text_images(path: Path) -> Iterator[_Image]:
    lines = _text_lines(path)
    for line in lines:
        if not line or line.startswith("#"):
            continue
        try:
            _, *numbers, camera, name = line.split(maxsplit=9)
            pose = tuple(float(number) for number in numbers)
            if len(pose) != 7:
                raise ValueError(line)
            yield _Image(name, int(camera), pose[:4], pose[4:])
        except ValueError:
            raise _bad_line("IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line) from None
        points = next(lines, "").split()  # of the previous image: X Y POINT3D_ID, any number of times
        if len(points) % 3 or (points and not points[-1].lstrip("-").isdigit()):
            expected = "X Y POINT3D_ID of each point of an image after its line, or an empty line"
            raise ValueError(f"{expected}, got {' '.join(points)[:80]!r}")


def _bad_line(expected: str, line: str) -> ValueError:
    return ValueError(f"lines {expected!r}, got {line[:80]!r}")


def calibration(model: CameraModel, parameters: Sequence[float]) -> tuple[Intrinsics, Distortion | None]:
    """Return the intrinsics of a camera of this model, and its distortion; None without distortion."""
    if model.distortion is None:
        hint = PINHOLES if model.name == PANORAMA else UNDISTORT
        raise ValueError(f"a camera of {READ_MODELS}, got {model.name}; {hint}")
    if len(parameters) != model.parameters:
        raise ValueError(f"{model.parameters} parameters of {model.name}, got {len(parameters)}")
    centre = model.focals + 2
    if not np.isfinite(parameters[centre:]).all():
        got = " ".join(f"{value:g}" for value in parameters[centre:])
        raise ValueError(f"finite {', '.join(model.distortion)}, got {got}")
    intrinsics = Intrinsics(parameters[0], parameters[model.focals - 1], *parameters[model.focals : centre])
    coefficients = dict(zip(model.distortion, parameters[centre:], strict=True))
    return intrinsics, distortion_of(coefficients, fisheye=model.fisheye)


def distortion_of(coefficients: Mapping[str, float], *, fisheye: bool) -> Distortion | None:
    """Return the distortion of coefficients by name, 0 if missing; None for a perspective camera without any."""
    if fisheye:
        return Fisheye(**coefficients)
    return Brown(**coefficients) if any(coefficients.values()) else None
