"""Lenses distort as OpenCV's and COLMAP's do; a distorted photo covers the image of its pinhole."""

from __future__ import annotations

import math

import numpy as np
import pytest

from liftcore.errors import InvalidCameras
from liftcore.io.colmap import MODELS_BY_NAME, calibration
from liftcore.scene.cameras import Camera, behind_lens
from liftcore.scene.distortion import FARTHEST, Brown, Distortion, Fisheye

POINTS = np.array([[0.1, 0.2], [-0.6, 0.45], [0.7, -0.5], [0.0, 0.55]])
RATIONAL = Brown(k1=-0.28, k2=0.09, k3=-0.015, k4=0.02, k5=-0.01, k6=0.004, p1=0.0012, p2=-0.0007)
# cv2.projectPoints of OpenCV 5.0.0; pycolmap 4.2.1 gives the same to 1e-16.
DISTORTED_POINTS = [
    [0.098525200191713, 0.19718040038342596],
    [-0.517986313441364, 0.388869422581023],
    [0.5768242947166292, -0.4114993533690209],
    [-0.00021175, 0.5061557854246465],
]
FISHEYE_POINTS = np.array([[0.1, 0.2], [-1.6, 0.45], [2.7, -3.5], [0.0, 0.55]])
FISHEYE = Fisheye(k1=0.03, k2=-0.012, k3=0.004, k4=-0.0006)
FISHEYE_DISTORTED_POINTS = [  # cv2.fisheye.projectPoints
    [0.09852172813528043, 0.19704345627056086],
    [-1.0128250612582874, 0.2848570484788933],
    [0.8502062347439255, -1.1021191931865701],
    [0.0, 0.5063030457420031],
]
# Where pycolmap 4.2.1 sees the ray (0.5, -0.4, 1).
OF_COLMAP = {
    "SIMPLE_PINHOLE": ((500, 320, 240), (570.0, 40.0)),
    "PINHOLE": ((500, 510, 320, 240), (570.0, 36.0)),
    "SIMPLE_RADIAL": ((500, 320, 240, -0.11), (558.725, 49.02)),
    "RADIAL": ((500, 320, 240, -0.11, 0.03), (559.98575, 48.0114)),
    "OPENCV": ((500, 510, 320, 240, -0.11, 0.03, 0.001, -0.002), (558.87575, 44.951928)),
    "FULL_OPENCV": (
        (500, 510, 320, 240, -0.11, 0.03, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003),
        (557.4435975401476, 46.120564407239584),
    ),
    "OPENCV_FISHEYE": ((500, 510, 320, 240, 0.03, -0.012, 0.004, -0.0006), (544.2779676528208, 56.989178395298154)),
    "SIMPLE_RADIAL_FISHEYE": ((500, 320, 240, 0.02), (543.8085570377422, 60.95315436980624)),
    "RADIAL_FISHEYE": ((500, 320, 240, 0.02, -0.01), (543.5745928385179, 61.14032572918563)),
}


def distorted_points(lens: Distortion, points: np.ndarray) -> np.ndarray:
    return np.stack(lens.distorted(points[:, 0], points[:, 1]), axis=1)


def straight(lens: Distortion, points: np.ndarray) -> np.ndarray:
    return np.stack(lens.straight(points[:, 0], points[:, 1]), axis=1)


@pytest.mark.parametrize(
    ("lens", "points", "distorted"),
    [(RATIONAL, POINTS, DISTORTED_POINTS), (FISHEYE, FISHEYE_POINTS, FISHEYE_DISTORTED_POINTS)],
)
def test_lenses_bend_as_those_of_opencv(lens: Distortion, points: np.ndarray, distorted: list[list[float]]) -> None:
    assert np.abs(distorted_points(lens, points) - distorted).max() < 1e-15
    assert np.abs(straight(lens, np.array(distorted)) - points).max() < 1e-8


@pytest.mark.parametrize("name", OF_COLMAP)
def test_models_of_colmap_show_a_ray_where_colmap_does(name: str) -> None:
    parameters, expected = OF_COLMAP[name]
    intrinsics, lens = calibration(MODELS_BY_NAME[name], parameters)
    u, v = (0.5, -0.4) if lens is None else distorted_points(lens, np.array([[0.5, -0.4]]))[0]
    assert np.allclose((intrinsics.fx * u + intrinsics.cx, intrinsics.fy * v + intrinsics.cy), expected, atol=1e-9)


def test_what_a_lens_cannot_show_has_no_way_back() -> None:
    folding = Brown(k1=-1.0)  # r (1 - r^2) is 0.385 at most
    assert np.isnan(straight(folding, np.array([[0.5, 0.0]]))).all()
    assert folding.reach(0.6) == pytest.approx(1 / math.sqrt(3), rel=0.003)
    assert folding.reach(0.5) == math.inf
    assert Brown(p2=0.1).reach(3.0) == pytest.approx(1 / 0.6, rel=0.01)  # x + 0.3 x^2 on the axis, to one side
    assert Brown(k4=-1.0).reach(2.0) == pytest.approx(1.0, rel=0.01)  # at a pole
    assert Fisheye(k1=-0.5).reach(2.0) == pytest.approx(math.tan(math.sqrt(2 / 3)), rel=0.005)  # 1 = 1.5 angle^2
    behind = straight(Fisheye(), np.array([[2.0, 0.0], [0.0, -1.8], [0.0, 0.0]]))  # 115 and 103 degrees off
    assert behind.tolist() == [[FARTHEST, 0.0], [0.0, -FARTHEST], [0.0, 0.0]]  # far out: no pinhole sees it


BARREL = Brown(k1=-0.2, k2=0.03, p1=0.001, p2=-0.002)
PINCUSHION = Brown(k1=0.15)
WIDE = Fisheye(k1=0.01, k2=-0.003)
LENSES = {"barrel": BARREL, "pincushion": PINCUSHION, "fisheye": WIDE}


def camera(distortion: Distortion) -> Camera:
    return behind_lens(Camera.pinhole("v", 64, 48, 50.0, 51.0, 31.36, 24.96, np.eye(4)), distortion)


@pytest.mark.parametrize("name", LENSES)
def test_the_pinhole_of_a_photo_is_the_largest_that_it_shows_whole(name: str) -> None:
    view = camera(LENSES[name])
    lens = view.lens
    assert lens is not None and view.photo_size == (64, 48)
    assert (view.fx, view.fy) == (lens.fx, lens.fy)

    def outside(of: Camera) -> float:
        """Return the distance of the farthest corner from the photo, in pixels of the photo."""
        x, y = np.meshgrid(np.arange(of.width + 1), np.arange(of.height + 1))
        u, v = lens.on_photo((x - of.cx) / of.fx, (y - of.cy) / of.fy)
        return float(max(-u.min(), u.max() - lens.width, -v.min(), v.max() - lens.height))

    assert outside(view) < 1e-9
    wider = [
        view.replace(width=view.width + 1, cx=view.cx + 1),
        view.replace(width=view.width + 1),
        view.replace(height=view.height + 1, cy=view.cy + 1),
        view.replace(height=view.height + 1),
    ]
    assert all(outside(other) > 0 for other in wider)


@pytest.mark.parametrize(
    ("distortion", "message"),
    [
        (Brown(k1=-9.0), r"covers \d\.\d% of the photo"),
        (Brown(k1=math.nan), "image within the photo is empty"),
        (Brown(k4=-2.0), "not monotonic within the photo"),
        (Fisheye(k1=-5.0), r"covers \d\.\d% of the photo"),
    ],
)
def test_what_no_lens_does_is_refused(distortion: Distortion, message: str) -> None:
    with pytest.raises(InvalidCameras, match=f"camera 'v' distortion: .*({message}).*calibrate"):
        camera(distortion)
