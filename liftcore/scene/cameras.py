"""Cameras with known poses, validated once."""

from __future__ import annotations

import math
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidCameras, NotFound
from liftcore.nearest import nearest
from liftcore.scene.view_pairs import cameras_of_views

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from liftcore.scene.lens import Lens

MAX_SIDE = 32_768  # pixels; larger images are a broken header, not a photo
MIN_FOCAL, MAX_FOCAL = 1e-3, 1e9  # pixels; float64 squares of what they project stay finite
MAX_OFF_CENTRE = 1e9  # pixels of the principal point
MAX_REACH = 1e12  # scene units from the origin; float32 has no detail left long before
MAX_VIEWS = 100_000  # of a scene: many times what anybody lifts, and read and checked in seconds
NEAREST = 3  # views named when one is unknown
SHOWN = 120  # characters of a name that is unknown
SAME_NAMES = (
    "a view is known by its photo's name without the suffix: rename photos, or, where training and test photos share "
    "names (Blender's scenes; Inria's cameras.json has the test views first), take one of both out or put "
    "their folders before them (train/r_0)"
)


@dataclass(frozen=True, eq=False)
class Camera:
    """One pinhole view. OpenCV axes (x right, y down, z forward), pixel centres at +0.5."""

    name: str  # the image's name without its extension; pairs the view with its features
    width: int  # pixels
    height: int  # pixels
    fx: float  # pixels
    fy: float  # pixels
    cx: float  # pixels, from the left edge of the first pixel
    cy: float  # pixels, from the top edge of the first pixel
    world_to_camera: np.ndarray  # [4, 4] f64, rigid
    lens: Lens | None = None  # of a distorted photo, which this pinhole stands for; None: the photo is as it says

    def __post_init__(self) -> None:
        pose = np.array(self.world_to_camera, dtype=np.float64)
        pose.setflags(write=False)
        object.__setattr__(self, "world_to_camera", pose)
        if not (0 < self.width <= MAX_SIDE and 0 < self.height <= MAX_SIDE):
            self._refuse("size", f"width and height in 1..{MAX_SIDE}", f"{self.width}x{self.height}")
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        if not all(math.isfinite(value) for value in intrinsics) or self.fx <= 0 or self.fy <= 0:
            self._refuse("intrinsics", "finite fx, fy, cx, cy with positive focal lengths", str(intrinsics))
        if not (min(intrinsics[:2]) >= MIN_FOCAL and max(intrinsics[:2]) <= MAX_FOCAL):
            self._refuse("intrinsics", f"focal lengths in {MIN_FOCAL:g}..{MAX_FOCAL:g} pixels", str(intrinsics))
        if max(abs(self.cx), abs(self.cy)) > MAX_OFF_CENTRE:
            self._refuse("intrinsics", f"a principal point within {MAX_OFF_CENTRE:g} pixels", str(intrinsics))
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            self._refuse("pose", "a finite 4x4 matrix", f"shape {list(pose.shape)}")
        rotation = pose[:3, :3]
        # Large entries are refused before the product, which they could overflow.
        error = float(np.abs(rotation).max())
        if error <= 2:
            error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if error > 1e-3 or np.linalg.det(rotation) < 0:
            self._refuse("pose", "a proper rotation", _what_it_is(rotation, error))
        reach = float(np.abs(pose[:3, 3]).max())
        if reach > MAX_REACH:
            self._refuse("pose", f"a translation within {MAX_REACH:g}", f"{reach:.2g}")

    def _refuse(self, part: str, expected: str, got: str) -> None:
        raise InvalidCameras(f"camera {self.name!r} {part}", expected=expected, got=got)

    @property
    def centre(self) -> np.ndarray:
        """[3] f64, the camera's centre in the world frame."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]


def _what_it_is(matrix: np.ndarray, error: float) -> str:
    scale = float(np.cbrt(np.linalg.det(matrix))) if np.abs(matrix).max() < MAX_REACH else 0.0
    if scale > 0 and np.abs(matrix @ matrix.T / scale**2 - np.eye(3)).max() < 1e-3:
        return f"a rotation scaled by {scale:.3g}"
    return f"a matrix off by {error:.2g}"


def world_to_camera(camera_to_world: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """[4, 4] f64 of a camera's axes in the world, [3, 3], and its centre, [3]; a ``Camera`` validates it."""
    pose = np.eye(4)
    pose[:3, :3] = camera_to_world.T
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is not finite, and is refused as such
        pose[:3, 3] = -camera_to_world.T @ centre
    return pose


@contextmanager
def told_of(source: str) -> Iterator[None]:
    """Name the file in what its cameras themselves find wrong, where the error does not name it."""
    try:
        yield
    except InvalidCameras as error:
        if source in error.argument:
            raise
        argument = f"{source} {error.argument}"
        raise InvalidCameras(argument, expected=error.expected, got=error.got, hint=error.hint) from None


def check_count(count: int, source: str) -> None:
    """Refuse more views than a scene may have, by their number alone.

    Raises:
        InvalidCameras: there are more than MAX_VIEWS.
    """
    if count > MAX_VIEWS:
        hint = "lift fewer photos, such as every second one"
        raise InvalidCameras(source, expected=f"at most {MAX_VIEWS} views", got=f"{count} or more", hint=hint)


@dataclass(frozen=True)
class Cameras:
    """The views of a scene, in file order, looked up by name."""

    views: tuple[Camera, ...]
    frame: str | None = None  # the name of the file by which they were moved to the frame of the splats
    of_nerfstudio: bool = False  # as its own converter writes them, and not moved

    def __post_init__(self) -> None:
        if not self.views:
            raise InvalidCameras("cameras", expected="at least one view", got="none")
        check_count(len(self.views), "cameras")
        seen: set[str] = set()
        for camera in self.views:
            if camera.name in seen:
                raise InvalidCameras(
                    "cameras", expected="one view a name", got=f"{camera.name!r} twice", hint=SAME_NAMES
                )
            seen.add(camera.name)

    @property
    def distorted(self) -> tuple[str, ...]:
        """The names of the views whose photos are distorted."""
        return tuple(camera.name for camera in self.views if camera.lens is not None)

    @cached_property
    def by_name(self) -> Mapping[str, Camera]:
        """Name -> camera."""
        return {camera.name: camera for camera in self.views}

    def get(self, name: str) -> Camera:
        """The view of that name, or of a name that pairs with it (`view_pairs`): lifts of before name rigs otherwise.

        Raises:
            NotFound: no view has it; the error names the nearest ones.
        """
        found = self.by_name.get(name) or self.by_name.get(cameras_of_views([name], self.by_name).get(name, ""))
        if found is None:
            got, hint = repr(name[:SHOWN]), nearest(name, self.by_name, NEAREST)
            raise NotFound("view", expected="the name of a camera", got=got, hint=hint)
        return found

    def __len__(self) -> int:
        return len(self.views)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.views)
