"""nerfstudio's transforms.json: what its keys mean, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_documents import assert_same, transforms_of, with_json
from colmap_files import binary_files, write_files

from liftcore.errors import InvalidCameras
from liftcore.io.cameras import read_cameras
from liftcore.scene.distortion import Brown, Fisheye, Lens


def test_transforms_and_colmap_mean_the_same(tmp_path: Path) -> None:
    cameras = read_cameras(write_files(tmp_path / "model", binary_files()))
    assert_same(read_cameras(with_json(tmp_path, transforms_of(cameras))), cameras)


def test_opengl_camera_looks_along_its_negative_z(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = [0, 0, 5]
    frame = {"file_path": "./train/r_0", "transform_matrix": pose.tolist()}
    document = {"camera_angle_x": math.pi / 2, "w": 100, "h": 50, "frames": [frame]}
    [camera] = read_cameras(with_json(tmp_path, document)).values()
    assert camera.name == "r_0"
    assert camera.fx == pytest.approx(50)
    assert camera.fy == camera.fx
    assert (camera.cx, camera.cy) == (50, 25)
    ahead = camera.viewmat @ [0, 1, 0, 1]  # below the camera along -z, and above it along y
    assert np.allclose(ahead, [0, -1, 5, 1])


def test_frame_intrinsics_come_before_shared_ones(tmp_path: Path) -> None:
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 70.0, "w": 20.0}
    document = {"fl_x": 50.0, "w": 100, "h": 50, "frames": [frame, {**frame, "file_path": "b.png", "w": 30}]}
    first, second = read_cameras(with_json(tmp_path, document)).values()
    assert (first.fx, first.fy, first.width, second.width, second.height) == (70.0, 70.0, 20, 30, 50)


GOOD_FRAME = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
SIZED = {"fl_x": 5, "w": 9, "h": 9, "frames": [GOOD_FRAME]}


def posed(matrix: Any) -> dict[str, Any]:
    return {"frames": [{"file_path": "a", "transform_matrix": matrix}]}


# What is other than in SIZED; None takes the key away.
BAD_TRANSFORMS = [
    ({"w": None}, "image size"),
    ({"fl_x": None}, "fl_x or camera_angle_x"),
    ({"fl_x": None, "fx": 5}, "neither, but 'fx'; add the focal length in pixels as fl_x"),
    ({"k1": -1}, r"document.json camera 'a' distortion.*a pinhole sees \d\.\d% of the photo"),
    ({"camera_model": "FISHEYE624"}, "FISHEYE624.*undistorter"),
    ({"k4": 0.1}, r"k1, k2, k3, p1, p2 alone of a perspective camera, got k4 = 0\.1.*undistorter"),
    ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, r"k1, k2, k3, k4 alone of a fisheye, got p1 = 0\.1"),
    ({"frames": None}, r"'frames' \(nerfstudio\) or a list of cameras.*got an object with fl_x"),
    ({"frames": []}, "document.json cameras: expected at least one view"),
    ({"frames": [1]}, "list of objects"),
    ({"frames": [{}]}, "'file_path'"),
    ({"frames": [{"file_path": "a"}]}, "matrix"),
    ({"fl_x": math.nan}, "a finite number, got nan"),
    ({"fl_x": 10**400}, "a finite number"),
    ({"fl_x": "50"}, "a finite number"),
    ({"w": 9.5}, "whole number of pixels"),
    ({"fl_x": None, "camera_angle_x": 4}, "an angle"),
    ({"fl_x": 0, "fl_y": 5}, "positive focal"),
    (
        posed(np.diag([2.0, 2, 2, 1]).tolist()),
        "camera 'a' pose: expected a proper rotation, got a rotation scaled by 2",
    ),
    (posed(np.diag([4.0, 2, 1, 1]).tolist()), "expected a proper rotation, got a matrix off by"),
    (posed([*np.eye(4).tolist()[:3], [1]]), "4x4 matrix as nested lists"),
    (posed((2 * np.eye(4)).tolist()), "0 0 0 1 as the last row, got 0 0 0 2"),
    ({"distortion_params": [0, 0.02]}, r"the 6 numbers k1, k2, k3, k4, p1, p2, got \[0, 0\.02\]"),
    ({"distortion_params": "k1"}, "a list of the 6 numbers .*, got 'k1'"),
    ({"distortion_params": [0, 0, 0, 0, 0, "x"]}, r"distortion_params\[5\]: expected a finite number, got 'x'"),
    (
        {"k1": 0.1, "distortion_params": [0, 0, 0, 0, 0, 0.02]},
        r"what the single parameters say, got k1 = 0\.1 and p2 = 0\.02",
    ),
    (
        {"k1": 0.1, "frames": [{**GOOD_FRAME, "k1": 0}]},
        r"the same distortion as that of all frames, got none and k1 = 0\.1",
    ),
    ({"ftheta_p0": 1.5}, "got ftheta_p0"),
    ({"equirectangular": True}, "equirectangular"),
]


PARAMETERS = {"k1": 0.1, "k2": -0.02, "p1": 0.001, "p2": -0.002}
LISTED = [0.1, -0.02, 0.0, 0.0, 0.001, -0.002]
BROWN = Brown(k1=0.1, k2=-0.02, p1=0.001, p2=-0.002)


@pytest.mark.parametrize(
    ("shared", "own", "lens"),
    [
        (PARAMETERS, {}, BROWN),
        ({}, PARAMETERS, BROWN),
        (PARAMETERS, PARAMETERS, BROWN),
        ({"distortion_params": LISTED}, {}, BROWN),
        ({}, {"distortion_params": LISTED, **PARAMETERS}, BROWN),
        ({"k3": 0.1, "camera_model": "OPENCV"}, {}, Brown(k3=0.1)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.01}, {}, Fisheye(k1=0.1, k4=0.01)),
        ({"camera_model": "OPENCV_FISHEYE"}, {}, Fisheye()),
        ({"is_fisheye": True, "k2": 0.1}, {}, Fisheye(k2=0.1)),
        ({"k1": 0, "distortion_params": []}, {"k1": 0.0}, None),
    ],
)
def test_distortion_of_transforms(
    shared: dict[str, Any], own: dict[str, Any], lens: Brown | Fisheye | None, tmp_path: Path
) -> None:
    document = {"fl_x": 90, "fl_y": 80, "w": 100, "h": 64, **shared, "frames": [{**GOOD_FRAME, **own}]}
    [view] = read_cameras(with_json(tmp_path, document)).values()
    assert view.lens == (None if lens is None else Lens(100, 64, 90.0, 80.0, 50.0, 32.0, lens))


@pytest.mark.parametrize(("changes", "message"), BAD_TRANSFORMS)
def test_bad_transforms_are_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    document = {key: value for key, value in {**SIZED, **changes}.items() if value is not None}
    with pytest.raises(InvalidCameras, match=message):
        read_cameras(with_json(tmp_path, document))
