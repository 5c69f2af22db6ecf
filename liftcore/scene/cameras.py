"""Cameras with known poses, validated once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from liftcore.errors import InvalidCameras, NotFound, reading
from liftcore.runtime.arguments import check_choice, nearest
from liftcore.runtime.one_line import join_names, one_line
from liftcore.scene.compositing import MAX_SIDE
from liftcore.scene.distortion import Distortion, Lens, Rectangle, shared_lens
from liftcore.scene.origin import FILE_ORIGIN, MAP_REACH, Origin
from liftcore.scene.similarity import NEAR, Similarity, similarity_of
from liftcore.scene.views import cameras_of_views, composed, require_few, without_image_suffix
from liftcore.scene.world import UNKNOWN, WorldFrame

if TYPE_CHECKING:  # torch is taken, and not loaded for it
    from torch import Tensor

    from liftcore.scene.similarity import Numbers

    Matrix = np.ndarray | Tensor | Sequence[Sequence[float]]

R = TypeVar("R")
Convention = Literal["opencv", "opengl", "blender"]
CAMERA_AXES = {  # convention -> the signs that turn a camera's axes into OpenCV's
    "opencv": np.array([1.0, 1.0, 1.0]),
    "opengl": np.array([1.0, -1.0, -1.0]),  # y up and z back become down and ahead
    "blender": np.array([1.0, -1.0, -1.0]),
}
NAME_SHOWN = 40  # characters of a name, of its end, in what prints of a camera
MIN_PIXELS = 8  # of a side, from which intrinsics of shares of the size are told from those in pixels
OFF_CENTRE, SAME_CENTRE = 1.25, 0.05  # of principal points off the middle, and the spread of their places
MIN_FOCAL, MAX_FOCAL = 1e-3, 1e9  # pixels; float64 squares of what they project stay finite
MAX_OFF_CENTRE = 1e9  # pixels of the principal point
NEAREST = 3  # views in the error of an unknown one
NEARLY_ALL = 0.995  # a share that would be printed as 100%
MAX_TEXT = 120  # characters of a value in an error
MAX_LISTED = 3  # skipped views in a warning
SAME_NAMES = (
    "a view has its photo's name without the suffix: rename photos, or, where training and test photos share "
    "names (Blender's scenes; Inria's cameras.json has the test views first), take one of both out or put "
    "their folders before them (train/r_0)"
)


class InvalidPose(InvalidCameras):
    """A pose is no rigid motion: a file of many views is read without the view (`read_views`)."""


@dataclass(frozen=True, eq=False, init=False)
class Camera:
    """One pinhole view, in gsplat's conventions: OpenCV axes (x right, y down, z forward), pixel centres at +0.5.

    A point p of the world lies at ``viewmat @ (p, 1)`` in the camera, and a point x of the camera at the pixel
    ``K @ x / x_z``.

    Args:
        viewmat: [4, 4] world to camera, rigid, of numpy, torch on any device, or nested lists.
        K: [3, 3] pixels, (fx 0 cx; 0 fy cy; 0 0 1), likewise.
        width: pixels. height: pixels.
        lens: of a distorted photo, which this pinhole stands for; None: the photo has no distortion.
        name: the image's name without its extension; pairs the view with its features. Kept composed (NFC).

    Raises:
        InvalidCameras: a size, an intrinsic or the pose is out of range; the error names which.
    """

    viewmat: np.ndarray
    """[4, 4] f64, read-only, on the CPU"""
    K: np.ndarray
    """[3, 3] f64, read-only, on the CPU"""
    width: int
    height: int
    lens: Lens | None
    name: str

    def __init__(
        self, viewmat: Matrix, K: Matrix, width: int, height: int, *, lens: Lens | None = None, name: str = ""
    ) -> None:
        if not isinstance(name, str):
            raise InvalidCameras("camera name", expected="a text, as of a photo", got=repr(name)[:MAX_TEXT])
        if lens is not None and not isinstance(lens, Lens):
            hint = "read_cameras reads lenses of COLMAP and nerfstudio; undistorted photos need none"
            raise InvalidCameras(f"camera {name!r} lens", expected="a Lens, or None", got=repr(lens)[:80], hint=hint)
        vars(self).update(viewmat=_matrix(viewmat), K=_matrix(K), width=_pixels(width), height=_pixels(height))
        vars(self).update(lens=lens, name=composed(name))
        label = f"camera {self.name!r}"
        with reading(f"{label} size", InvalidCameras, f"width and height, whole numbers in 1..{MAX_SIDE}"):
            if not (0 < self.width <= MAX_SIDE and 0 < self.height <= MAX_SIDE):
                raise ValueError(f"{width!r} x {height!r}")
        with reading(f"{label} K", InvalidCameras, "a 3x3 matrix (fx 0 cx; 0 fy cy; 0 0 1) without skew"):
            _check_matrix(self.K)
        with reading(f"{label} intrinsics", InvalidCameras, "fx, fy, cx, cy in pixels"):
            self._check_intrinsics()
        with reading(f"{label} pose", InvalidPose, "a pose"):
            _check_pose(self.viewmat)

    @classmethod
    def pinhole(
        cls, name: str, width: int, height: int, fx: float, fy: float, cx: float, cy: float, viewmat: Matrix
    ) -> Camera:
        """Make a camera of intrinsics in pixels, the principal point from the left and top edge of the image."""
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return cls(viewmat, K, width, height, name=name)

    @classmethod
    def from_camera_to_world(
        cls, pose: Matrix, K: Matrix, width: int, height: int, *, convention: Convention, name: str = ""
    ) -> Camera:
        """Return a camera of its pose in the world, whose axes follow a named convention.

        Args:
            pose: [4, 4] or [3, 4] camera to world, rigid: the columns are the camera's axes and its centre.
            K: [3, 3] pixels. width: pixels. height: pixels.
            convention: of the camera's axes. ``opencv``: x right, y down, z ahead (COLMAP, gsplat); ``opengl``, the
                same as ``blender``: x right, y up, z back (NeRF, nerfstudio's transforms.json). It has no default, as
                either would be wrong for half of all files without any error.

        Raises:
            InvalidCameras: an unknown convention, or as the constructor has it.
        """
        check_choice(f"camera {name!r} convention", convention, CAMERA_AXES, InvalidCameras)
        pose_matrix = _matrix(pose)
        if pose_matrix.shape not in ((4, 4), (3, 4)):
            expected, got = "a finite 4x4 or 3x4 matrix", f"shape {list(pose_matrix.shape)}"
            raise InvalidCameras(f"camera {name!r} pose", expected=expected, got=got)
        return cls(viewmat_of(pose_matrix, convention), K, width, height, name=name)

    def transformed(self, matrix: Numbers) -> Camera:
        """Return the camera in another frame of the world, ``p' = scale R p + translation`` (`Splats.transformed`).

        Raises:
            InvalidInput: it is no similarity.
        """
        move = Similarity.of(matrix)
        rotation_product = self.viewmat[:3, :3] @ move.rotation.T
        pose = np.eye(4)
        pose[:3, :3] = rotation_product
        pose[:3, 3] = move.scale * self.viewmat[:3, 3] - rotation_product @ move.translation
        return replace(self, viewmat=pose)

    def __repr__(self) -> str:
        kind = ["distorted"] * bool(self.lens)
        numbers = {"fx": self.fx, "fy": self.fy, "cx": self.cx, "cy": self.cy}
        K = [f"{name}={value:.6g}" for name, value in numbers.items()]
        return one_line(self, repr(self.name[-NAME_SHOWN:]), f"{self.width}x{self.height}", *K, *kind)

    def replace(self, **changes: Any) -> Camera:
        """Return the same camera with other fields, or with another ``fx``, ``fy``, ``cx`` or ``cy``.

        Raises:
            InvalidCameras: there is no such field, or as the constructor has it.
        """
        K = _matrix(changes.pop("K", self.K)).copy()
        names = [field.name for field in fields(self)]
        argument, expected = f"camera {self.name!r} {' '.join(changes)}", f"one of {', '.join(names)}, fx, fy, cx, cy"
        with reading(argument, InvalidCameras, expected):
            for place, key in (((0, 0), "fx"), ((1, 1), "fy"), ((0, 2), "cx"), ((1, 2), "cy")):
                if key in changes:
                    K[place] = changes.pop(key)
            return replace(self, K=K, **changes)

    def _check_intrinsics(self) -> None:
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        if not all(math.isfinite(value) for value in intrinsics) or self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"finite fx, fy, cx, cy with positive focal lengths, got {intrinsics}")
        is_share = max(intrinsics[:2]) < MIN_PIXELS and max(intrinsics[2:]) <= 1
        if min(self.width, self.height) >= MIN_PIXELS and is_share:
            hint = f"multiply fx and cx by {self.width}, fy and cy by {self.height}"
            raise ValueError(f"fx, fy, cx, cy in pixels, got {intrinsics}, shares of the image's size; {hint}")
        if not (min(intrinsics[:2]) >= MIN_FOCAL and max(intrinsics[:2]) <= MAX_FOCAL):
            raise ValueError(f"focal lengths in {MIN_FOCAL:g}..{MAX_FOCAL:g} pixels, got {intrinsics}")
        if max(abs(self.cx), abs(self.cy)) > MAX_OFF_CENTRE:
            raise ValueError(f"a principal point within {MAX_OFF_CENTRE:g} pixels, got {intrinsics}")

    @property
    def fx(self) -> float:
        """Focal length in x, pixels."""
        return float(self.K[0, 0])

    @property
    def fy(self) -> float:
        """Focal length in y, pixels."""
        return float(self.K[1, 1])

    @property
    def cx(self) -> float:
        """Principal point, pixels from the left edge of the first pixel."""
        return float(self.K[0, 2])

    @property
    def cy(self) -> float:
        """Principal point, pixels from the top edge of the first pixel."""
        return float(self.K[1, 2])

    @property
    def photo_size(self) -> tuple[int, int]:
        """Width and height in pixels of the photo that it stands for: with a lens larger than its own."""
        image = self.lens or self
        return image.width, image.height

    @property
    def centre(self) -> np.ndarray:
        """[3] f64, the camera's centre in the world frame."""
        rotation, translation = self.viewmat[:3, :3], self.viewmat[:3, 3]
        centre = -rotation.T @ translation
        if np.abs(translation).max() > MAP_REACH:  # there a rotation of float32 digits, turned back, misses by metres
            centre = np.linalg.solve(rotation, -translation)
        return centre

    def about(self, origin: Origin) -> Camera:
        """Return the same camera in the world frame less an origin: a point p - origin lies where p did."""
        if origin == FILE_ORIGIN:
            return self
        pose = self.viewmat.copy()
        pose[:3, 3] += pose[:3, :3] @ origin
        return replace(self, viewmat=pose)


def _matrix(values: Any) -> np.ndarray:
    """Return a read-only copy as f64 on the CPU, of numpy, nested lists or torch, which is not imported for it."""
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    try:
        matrix = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.full((0,), np.nan)  # no numbers: refused by its shape
    matrix.setflags(write=False)
    return matrix


def _pixels(side: Any) -> int:
    """Convert a whole number of any type to int; anything else becomes 0, which is refused."""
    try:
        return int(side) if int(side) == side and not isinstance(side, bool) else 0
    except (TypeError, ValueError, OverflowError):
        return 0


def _check_matrix(K: np.ndarray) -> None:
    """Refuse a matrix that is none of intrinsics."""
    if K.shape != (3, 3):
        raise ValueError(f"shape {list(K.shape)}")
    if (K[0, 1], K[1, 0], *K[2].tolist()) != (0.0, 0.0, 0.0, 0.0, 1.0):
        raise ValueError(" | ".join(" ".join(f"{value:g}" for value in row) for row in K))


def _check_pose(pose: np.ndarray) -> None:
    """Refuse a matrix that is no rigid motion."""
    if pose.shape != (4, 4):
        raise ValueError(f"a finite 4x4 matrix, got shape {list(pose.shape)}")
    scale = similarity_of(pose).scale
    if abs(scale**2 - 1) > NEAR:
        raise ValueError(f"a proper rotation, got a rotation scaled by {scale:.3g}")


def intrinsics_factor(cameras: Sequence[Camera]) -> float | None:
    """Return what brings all principal points to the middles of their images; None if they are there, or differ."""
    shares = np.array([(2 * camera.cx / camera.width, 2 * camera.cy / camera.height) for camera in cameras])
    share = float(np.median(shares)) if len(shares) else 1.0
    is_off = share > 0 and not 1 / OFF_CENTRE < share < OFF_CENTRE and np.ptp(shares) < SAME_CENTRE * share
    return 1 / share if is_off else None


def intrinsics_advice(factor: float) -> str:
    """Explain such a factor, and say what to do."""
    return (
        f"fx, fy, cx, cy are those of a picture of {1 / factor:.3g} times the size; multiply them by {factor:.4g} "
        "or give the cameras that picture's width and height"
    )


class Cameras(Mapping[str, Camera]):
    """The views of a scene by their names, in file order.

    Args:
        views: a mapping of names to cameras, whose names win over those of the cameras; or named cameras.
        frame: the name of the file with the transform that was applied, to the frame of the splats; None: none.
        world: the up axis, if their file has it.
        warnings: of their reader, also shown by plans and lifts: views that were skipped, files that were not read.

    Raises:
        InvalidCameras: there are none, more than MAX_VIEWS, two of one name, or something else than cameras.
    """

    def __init__(
        self,
        views: Mapping[str, Camera] | Iterable[Camera],
        *,
        frame: str | None = None,
        world: WorldFrame = UNKNOWN,
        warnings: Iterable[str] = (),
    ) -> None:
        self.frame = frame
        self.world = world
        self.warnings = tuple(warnings)
        if not isinstance(views, Mapping):
            is_sequence = isinstance(views, Iterable) and not isinstance(views, str | np.ndarray)
            cameras: list[Any] = [*views] if is_sequence else [views]
            named_views = [(getattr(camera, "name", ""), camera) for camera in cameras]
        else:
            named_views = [*views.items()]
        if not named_views:
            raise InvalidCameras("cameras", expected="at least one view", got="none")
        require_few(named_views)
        self._by_name: dict[str, Camera] = {}
        for name, view in named_views:
            if not isinstance(view, Camera) or not isinstance(name, str):
                got, hint = f"{type(view).__name__} {view!r}"[:80], "read_cameras(path) makes them of a file"
                expected = "a Camera for each name, a text as of a photo"
                raise InvalidCameras("cameras", expected=expected, got=f"{got} of {name!r}"[:120], hint=hint)
            camera = view if view.name == name else view.replace(name=name)
            if camera.name in self._by_name:
                got = f"{camera.name!r} twice"
                hint = SAME_NAMES if camera.name else "give a dict of names to cameras, or Camera(..., name=...)"
                raise InvalidCameras("cameras", expected="one view a name", got=got, hint=hint)
            self._by_name[camera.name] = camera

    def __getitem__(self, name: str) -> Camera:
        """Return the view of a name, or of one that pairs with it (`cameras_of_views`): older lifts have other names.

        Raises:
            NotFound: no view has it; the error, which is a KeyError, names the nearest ones.
        """
        if not isinstance(name, str):
            expected, got = "the name of a camera", f"{type(name).__name__} {name!r}"[:MAX_TEXT]
            raise NotFound("view", expected=expected, got=got, hint="list(cameras) are the names, in their order")
        view_name = without_image_suffix(name)  # a photo's file names its view
        camera = self._by_name.get(composed(name)) or self._by_name.get(view_name)
        camera = camera or self._by_name.get(cameras_of_views([view_name], self).get(view_name, ""))
        if camera is None:
            got, hint = repr(name[:MAX_TEXT]), nearest(name, self, NEAREST)
            raise NotFound("view", expected="the name of a camera", got=got, hint=hint)
        return camera

    def __contains__(self, name: object) -> bool:
        """Return True if a view has exactly that name."""
        return isinstance(name, str) and composed(name) in self._by_name

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)

    def __repr__(self) -> str:
        listing = ", ".join(repr(name[-NAME_SHOWN:]) for name in list(self)[:2]) + (", ..." if len(self) > 2 else "")
        return one_line(self, f"{len(self)} views: {listing}")

    def transformed(self, matrix: Numbers) -> Cameras:
        """Return all cameras in another frame of the world (`Camera.transformed`).

        Raises:
            InvalidInput: it is no similarity.
        """
        cameras = [camera.transformed(matrix) for camera in self.values()]
        world = self.world.transformed(Similarity.of(matrix))
        return Cameras(cameras, world=world, warnings=self.warnings)

    @property
    def distorted(self) -> tuple[str, ...]:
        """The names of the views whose photos are distorted."""
        return tuple(name for name, camera in self._by_name.items() if camera.lens is not None)


def viewmat_of(pose: np.ndarray, convention: Convention) -> np.ndarray:
    """Return [4, 4] f64 of a camera's pose in the world, [4, 4] or [3, 4]; a ``Camera`` validates it, row 4 too."""
    viewmat, rotation = np.eye(4), (pose[:3, :3] * CAMERA_AXES[convention]).T
    viewmat[:3, :3] = rotation
    with np.errstate(over="ignore", invalid="ignore"):  # an overflow is not finite, and is refused as such
        viewmat[:3, 3] = -rotation @ pose[:3, 3]
    viewmat[3] = pose[3] if len(pose) == 4 else viewmat[3]
    return viewmat


def read_views(
    views: Iterable[tuple[str, R]], camera_of: Callable[[str, R], Camera]
) -> tuple[list[Camera], list[str]]:
    """Return the cameras of a file's views, and a warning that names those that were skipped for a broken pose."""
    cameras: list[Camera] = []
    broken: dict[str, InvalidPose] = {}
    for name, record in views:
        try:
            cameras.append(camera_of(name, record))
        except InvalidPose as error:
            broken[name] = error
    if not broken:
        return cameras, []
    first = next(iter(broken.values()))
    if not cameras:
        raise first
    listing = join_names(list(map(repr, broken)), MAX_LISTED)
    count = f"{len(broken)} cameras were skipped for broken poses and {len(cameras)} read"
    return cameras, [f"{count}: {listing}, the first with {first.got} in place of {first.expected}"]


def behind_lens(camera: Camera, distortion: Distortion | None) -> Camera:
    """Return the camera of a photo, perhaps distorted, from a camera with the photo's size and intrinsics."""
    if distortion is None:
        return camera
    photo = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    lens = shared_lens(Lens(*photo, distortion))
    hint = "calibrate the camera again, or undistort the photos, and train and lift on them"
    with reading(f"camera {camera.name!r} distortion", InvalidCameras, "one that a lens may have", hint):
        return _pinhole(camera, lens, lens.inner)


def drawn_by(camera: Camera) -> Camera:
    """Return the pinhole that renders images of a camera: itself, or one that covers its distorted photo."""
    return camera if camera.lens is None else _pinhole(camera, camera.lens, camera.lens.outer)


def pixel_of(camera: Camera, x: int, y: int) -> tuple[int, int] | None:
    """Return the pixel of ``drawn_by`` that shows what the photo's pixel does; None where it shows none of it."""
    if camera.lens is None:
        return x, y
    pinhole, lens = drawn_by(camera), camera.lens
    across, down = lens.on_plane(np.array([x + 0.5]), np.array([y + 0.5]))
    column, row = (float(np.floor(at)) for at in (across[0] * lens.fx + pinhole.cx, down[0] * lens.fy + pinhole.cy))
    inside = 0 <= column < pinhole.width and 0 <= row < pinhole.height
    return (int(column), int(row)) if inside else None


def distortion_warning(views: Sequence[Camera]) -> list[str]:
    """Return a warning of distorted views, if there are any."""
    shares = [camera.lens.share for camera in views if camera.lens is not None]
    if not shares:
        return []
    least = min(shares)
    lifted = "nearly all" if least > NEARLY_ALL else f"{least:.0%} or more"
    return [
        f"{len(shares)} of {len(views)} views are of distorted photos, of each of which {lifted} is "
        "lifted: features must be of the photos as they were taken, not of undistorted ones"
    ]


def _pinhole(camera: Camera, lens: Lens, rectangle: Rectangle) -> Camera:
    width, height = rectangle.right - rectangle.left, rectangle.bottom - rectangle.top
    return camera.replace(
        width=width, height=height, cx=lens.cx - rectangle.left, cy=lens.cy - rectangle.top, lens=lens
    )
