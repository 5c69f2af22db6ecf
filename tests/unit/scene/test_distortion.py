"""Distortion is that of OpenCV and COLMAP, and can be undone wherever a lens shows one ray in one place."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liftcore.io.colmap import MODELS_BY_NAME, calibration
from liftcore.scene.distortion import FARTHEST, Brown, Distortion, Fisheye

POINTS = np.array([[0.1, 0.2], [-0.6, 0.45], [0.7, -0.5], [0.0, 0.55]])
RATIONAL = Brown(k1=-0.28, k2=0.09, k3=-0.015, k4=0.02, k5=-0.01, k6=0.004, p1=0.0012, p2=-0.0007)
# cv2.projectPoints of OpenCV 5.0.0; pycolmap 4.2.1 gives the same to 1e-16.
BENT = [
    [0.098525200191713, 0.19718040038342596],
    [-0.517986313441364, 0.388869422581023],
    [0.5768242947166292, -0.4114993533690209],
    [-0.00021175, 0.5061557854246465],
]
WIDE_POINTS = np.array([[0.1, 0.2], [-1.6, 0.45], [2.7, -3.5], [0.0, 0.55]])
WIDE = Fisheye(k1=0.03, k2=-0.012, k3=0.004, k4=-0.0006)
WIDE_BENT = [  # cv2.fisheye.projectPoints
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


def bent(lens: Distortion, points: np.ndarray) -> np.ndarray:
    return np.stack(lens.bent(points[:, 0], points[:, 1]), axis=1)


def straight(lens: Distortion, points: np.ndarray) -> np.ndarray:
    return np.stack(lens.straight(points[:, 0], points[:, 1]), axis=1)


@pytest.mark.parametrize(("lens", "points", "seen"), [(RATIONAL, POINTS, BENT), (WIDE, WIDE_POINTS, WIDE_BENT)])
def test_lenses_bend_as_those_of_opencv(lens: Distortion, points: np.ndarray, seen: list[list[float]]) -> None:
    assert np.abs(bent(lens, points) - seen).max() < 1e-15
    assert np.abs(straight(lens, np.array(seen)) - points).max() < 1e-8


@pytest.mark.parametrize("name", OF_COLMAP)
def test_models_of_colmap_show_a_ray_where_colmap_does(name: str) -> None:
    parameters, seen = OF_COLMAP[name]
    intrinsics, lens = calibration(MODELS_BY_NAME[name], parameters, "a camera")
    u, v = (0.5, -0.4) if lens is None else bent(lens, np.array([[0.5, -0.4]]))[0]
    assert np.allclose((intrinsics.fx * u + intrinsics.cx, intrinsics.fy * v + intrinsics.cy), seen, atol=1e-9)


@given(
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.05, 0.05), st.floats(-0.01, 0.01)),
    st.tuples(st.floats(-0.005, 0.005), st.floats(-0.005, 0.005)),
    st.floats(0, 6.3),
    st.floats(0, 0.8),
)
def test_a_perspective_lens_is_undone_where_it_does_not_turn_back(
    k: tuple[float, float, float], p: tuple[float, float], angle: float, radius: float
) -> None:
    lens = Brown(k1=k[0], k2=k[1], k3=k[2], p1=p[0], p2=p[1])
    point = radius * np.array([[np.cos(angle), np.sin(angle)]])
    if lens.reach(1.05 * radius) == math.inf:
        assert np.abs(straight(lens, bent(lens, point)) - point).max() < 1e-6


@given(st.tuples(*[st.floats(-0.02, 0.02)] * 4), st.floats(0, 6.3), st.floats(0, 1.4))
def test_a_fisheye_is_undone_where_it_does_not_turn_back(
    k: tuple[float, float, float, float], angle: float, off_axis: float
) -> None:
    lens, radius = Fisheye(*k), np.tan(off_axis)
    point = radius * np.array([[np.cos(angle), np.sin(angle)]])
    if lens.reach(np.tan(off_axis + 0.05)) == math.inf:
        assert np.abs(straight(lens, bent(lens, point)) - point).max() < 1e-5


def test_what_a_lens_cannot_show_has_no_way_back() -> None:
    folding = Brown(k1=-1.0)  # r (1 - r^2) is 0.385 at most
    assert np.isnan(straight(folding, np.array([[0.5, 0.0]]))).all()
    assert folding.reach(0.6) == pytest.approx(1 / math.sqrt(3), rel=0.003)
    assert folding.reach(0.5) == math.inf
    assert Brown(p2=0.1).reach(3.0) == pytest.approx(1 / 0.6, rel=0.01)  # x + 0.3 x^2 on the axis, to one side
    assert Brown(k4=-1.0).reach(2.0) == pytest.approx(1.0, rel=0.01)  # at a pole
    assert Fisheye(k1=-0.5).reach(2.0) == pytest.approx(math.tan(math.sqrt(2 / 3)), rel=0.005)  # 1 = 1.5 angle^2


def test_a_fisheye_sees_what_no_pinhole_does_far_out() -> None:
    equidistant = Fisheye()
    behind = straight(equidistant, np.array([[2.0, 0.0], [0.0, -1.8], [0.0, 0.0]]))  # 115 and 103 degrees off
    assert behind.tolist() == [[FARTHEST, 0.0], [0.0, -FARTHEST], [0.0, 0.0]]
