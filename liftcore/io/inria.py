"""The cameras.json that Inria's trainer writes beside its splats."""

from typing import Any

from liftcore.errors import InvalidCameras
from liftcore.io.json_file import FORMATS, entry, matrix, number, pixels
from liftcore.scene.cameras import Camera, Cameras, check_count, pose_from, read_views, viewmat_of
from liftcore.scene.views import view_names


def parse_inria(document: Any, source: str) -> Cameras:
    """Parse a cameras.json document; the format puts the principal point at the image's centre."""
    if not isinstance(document, list):
        raise InvalidCameras(source, expected="a list of cameras", got=type(document).__name__)
    if document and not (isinstance(document[0], dict) and "img_name" in document[0]):
        got = f"a list of {type(document[0]).__name__}"
        if isinstance(document[0], dict):
            got = f"a list of objects with {', '.join(list(document[0])[:5])}"
        raise InvalidCameras(source, expected=FORMATS, got=got)
    check_count(len(document), source)
    images = [str(entry(record, "img_name", f"{source} camera {i}")) for i, record in enumerate(document)]
    views = zip(view_names(images), document, strict=True)
    cameras, warnings = read_views(views, lambda name, record: _cameras(name, record, source))
    return Cameras(cameras, warnings=warnings)


def _cameras(name: str, record: dict[str, Any], source: str) -> list[Camera]:
    camera_source = f"{source} camera {name!r}"
    width, height = (
        pixels(entry(record, key, camera_source), f"{camera_source} {key}") for key in ("width", "height")
    )
    fx, fy = (number(entry(record, key, camera_source), f"{camera_source} {key}") for key in ("fx", "fy"))
    with pose_from():
        rotation = matrix(entry(record, "rotation", camera_source), (3,), 3, f"{camera_source} rotation")
        (position,) = matrix([entry(record, "position", camera_source)], (1,), 3, f"{camera_source} position")
    pose = viewmat_of(rotation, position)
    return [Camera.pinhole(name, width, height, fx, fy, width / 2, height / 2, viewmat=pose)]
