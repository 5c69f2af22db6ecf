"""Camera files: all formats mean the same cameras; distortion and damage are refused, never ignored."""

from __future__ import annotations

import math
import shutil
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_documents import transforms_of, with_json
from colmap_files import IMAGES, binary_files, text_files, write_files

from liftcore.errors import InvalidCameras, InvalidSplats
from liftcore.scene import json_file, model_zip
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.inria import write_inria_cameras
from liftcore.scene.inspect import describe_camera_file
from liftcore.scene.load import load_cameras, load_splats, other_models


def assert_same(one: Cameras, other: Cameras) -> None:
    assert [view.name for view in one] == [view.name for view in other]
    for a, b in zip(one, other, strict=True):
        assert (a.width, a.height) == (b.width, b.height)
        assert np.allclose([a.fx, a.fy, a.cx, a.cy], [b.fx, b.fy, b.cx, b.cy], atol=1e-9)
        assert np.allclose(a.world_to_camera, b.world_to_camera, atol=1e-12)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return write_files(tmp_path / "model", binary_files())


def test_binary_and_text_models_mean_the_same(model: Path, tmp_path: Path) -> None:
    assert_same(load_cameras(model), load_cameras(write_files(tmp_path / "text", text_files())))


def test_colmap_poses_are_world_to_camera(model: Path) -> None:
    cameras = load_cameras(model)
    assert [view.name for view in cameras] == ["frame 1", "frame_2", "frame.0003"]
    first, second, third = cameras
    assert (first.fx, first.fy, first.cx, first.cy) == (500.0, 510.0, 320.5, 239.5)
    assert (second.fx, second.fy) == (400.0, 400.0)
    assert np.allclose(first.centre, [0, 0, -2])
    assert np.allclose(second.world_to_camera[:3, :3] @ [1, 0, 0], [0, 1, 0])  # a third of a turn about (1, 1, 1)
    assert np.allclose(third.world_to_camera[:3, :3], np.diag([-1, 1, -1]))  # the quaternion is normalised


@pytest.mark.parametrize("place", [".", "sparse/0", "sparse", "0"])
def test_model_is_found_in_a_scene_folder(place: str, tmp_path: Path, model: Path) -> None:
    write_files(tmp_path / "scene" / place, binary_files())
    assert_same(load_cameras(tmp_path / "scene"), load_cameras(model))


@pytest.mark.parametrize("root", ["", "scene/sparse/0/", "../../"])
@pytest.mark.parametrize("files", [binary_files, text_files])
def test_zipped_model_is_read_at_any_depth(root: str, files: Any, tmp_path: Path, model: Path) -> None:
    path = tmp_path / "upload.bin"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{root}points3D.bin", b"never read")
        for name, content in files().items():
            archive.writestr(root + name, content)
    before = sorted(tmp_path.rglob("*"))
    assert_same(load_cameras(path), load_cameras(model))
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("packed", [False, True])
def test_models_that_are_not_read_are_told(packed: bool, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    for place in ("sparse/0", "sparse/1"):
        write_files(scene / place, binary_files())
    write_files(scene / "sparse/0", text_files())  # the same model once more
    write_files(scene / "sparse/2", {"points3D.bin": b"of no whole model"})
    path = Path(shutil.make_archive(str(scene), "zip", scene)) if packed else scene
    assert describe_camera_file(path)["warnings"] == ["1 more COLMAP models were not read: sparse/1"]
    assert other_models(scene / "sparse/1") == []


def test_zip_bomb_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_zip, "MAX_UNZIPPED_BYTES", 1000)
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("cameras.bin", bytes(100_000))
        archive.writestr("images.bin", b"")
    with pytest.raises(InvalidCameras, match="at most 1000 bytes unzipped"):
        load_cameras(path)


def test_zip_without_a_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(InvalidCameras, match="COLMAP model"):
        load_cameras(path)


def test_error_in_a_zip_names_the_zip(tmp_path: Path) -> None:
    path = tmp_path / "short.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("cameras.bin", binary_files()["cameras.bin"])
        archive.writestr("images.bin", b"")
    with pytest.raises(InvalidCameras) as caught:
        load_cameras(path)
    assert str(caught.value).startswith(f"{path}/images.bin")


@pytest.mark.parametrize(
    ("number", "name", "parameters"),
    [
        (2, "SIMPLE_RADIAL", (500.0, 320.0, 240.0, 0.0)),
        (3, "RADIAL", (500.0, 320.0, 240.0, 0.0, 0.0)),
        (4, "OPENCV", (500.0, 500.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0)),
        (6, "FULL_OPENCV", (500.0, 500.0, 320.0, 240.0, *[0.0] * 8)),
    ],
)
def test_distorted_model_is_a_pinhole_only_without_distortion(
    number: int, name: str, parameters: tuple[float, ...], tmp_path: Path
) -> None:
    for files in (binary_files, text_files):
        sensor = {1: (number, name, parameters)}
        straight = load_cameras(write_files(tmp_path / files.__name__, files(sensor, IMAGES[:1])))
        assert (straight.views[0].fx, straight.views[0].fy, straight.views[0].cx) == (500.0, 500.0, 320.0)
        bent = {1: (number, name, (*parameters[:-1], 0.01))}
        with pytest.raises(InvalidCameras, match=r"without distortion.*0\.01.*colmap image_undistorter"):
            load_cameras(write_files(tmp_path / files.__name__, files(bent, IMAGES[:1])))


def test_fisheye_is_refused(tmp_path: Path) -> None:
    sensor = {1: (5, "OPENCV_FISHEYE", (500.0, 500.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))}
    for files in (binary_files, text_files):
        with pytest.raises(InvalidCameras, match=r"perspective.*OPENCV_FISHEYE.*image_undistorter"):
            load_cameras(write_files(tmp_path / files.__name__, files(sensor, IMAGES[:1])))


DAMAGED = {
    "count bomb": (
        {"images.bin": struct.pack("<Q", 2**62)},
        "4611686018427387904 images, got a file that ends 0 bytes after",
    ),
    "camera count bomb": ({"cameras.bin": struct.pack("<Q", 2**40)}, "1099511627776 cameras, got a file that ends"),
    "empty": ({"images.bin": b""}, "ends after 0"),
    "cut": ({"images.bin": binary_files()["images.bin"][:-9]}, "bytes"),
    "unknown model": (binary_files({1: (99, "", (1.0, 1.0, 1.0, 1.0))}), "model id 99"),
    "unknown camera": (binary_files(images=[(9, *IMAGES[0][1:])]), "of camera 9"),
    "zero quaternion": (binary_files(images=[(1, (0.0,) * 4, *IMAGES[0][2:])]), "not zero"),
    "NaN quaternion": (binary_files(images=[(1, (math.nan,) * 4, *IMAGES[0][2:])]), "finite quaternion"),
    "NaN translation": (binary_files(images=[(*IMAGES[0][:2], (math.nan, 0.0, 0.0), "a.jpg")]), "finite 4x4"),
    "NaN focal length": (binary_files({1: (1, "", (math.nan, 1.0, 1.0, 1.0))}, IMAGES[:1]), "focal"),
    "no images": (binary_files(images=[]), "at least one view"),
    "same name twice": (binary_files(images=[IMAGES[0], IMAGES[0]]), "'frame 1' twice"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_binary_model_is_refused(case: str, tmp_path: Path) -> None:
    files, message = DAMAGED[case]
    with pytest.raises(InvalidCameras, match=message) as caught:
        load_cameras(write_files(tmp_path, binary_files() | files))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cameras.txt", b"1 PINHOLE wide 480 1 1 1 1\n", "CAMERA_ID MODEL"),
        ("cameras.txt", b"1 PINHOLE 640 480 1 1 1\n", "4 parameters of PINHOLE, got 3"),
        ("cameras.txt", b"1 CROOKED 640 480 1 1 1\n", "CROOKED"),
        ("images.txt", b"0 1 0 0 0 0 0 2\n", "IMAGE_ID QW"),
        ("images.txt", b"0 1 0 0 0 0 0 zwei 1 a.jpg\n\n", "IMAGE_ID QW"),
        ("images.txt", b"0 1 0 0 0 0 0 2 1 a.jpg\n1 1 0 0 0 0 0 2 1 b.jpg\n", "or an empty line, got '1 1 0"),
        ("images.txt", b"0 1 0 0 0 0 0 2 1 a.jpg\n1 1 0 0 0 0 0 2 1 b of c.jpg\n", "or an empty line"),
    ],
)
def test_damaged_text_model_is_refused(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidCameras, match=message):
        load_cameras(write_files(tmp_path, text_files() | {name: content}))


def test_missing_images_file_is_named(tmp_path: Path) -> None:
    write_files(tmp_path, {"cameras.bin": binary_files()["cameras.bin"]})
    with pytest.raises(InvalidCameras, match=r"images\.bin"):
        load_cameras(tmp_path)


def test_transforms_and_colmap_mean_the_same(model: Path, tmp_path: Path) -> None:
    cameras = load_cameras(model)
    assert_same(load_cameras(with_json(tmp_path, transforms_of(cameras))), cameras)


def test_opengl_camera_looks_along_its_negative_z(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = [0, 0, 5]
    frame = {"file_path": "./train/r_0", "transform_matrix": pose.tolist()}
    document = {"camera_angle_x": math.pi / 2, "w": 100, "h": 50, "frames": [frame]}
    camera = load_cameras(with_json(tmp_path, document)).views[0]
    assert camera.name == "r_0"
    assert camera.fx == pytest.approx(50)
    assert camera.fy == camera.fx
    assert (camera.cx, camera.cy) == (50, 25)
    ahead = camera.world_to_camera @ [0, 1, 0, 1]  # below the camera along -z, and above it along y
    assert np.allclose(ahead, [0, -1, 5, 1])


def test_frame_intrinsics_come_before_shared_ones(tmp_path: Path) -> None:
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 70.0, "w": 20.0}
    document = {"fl_x": 50.0, "w": 100, "h": 50, "frames": [frame, {**frame, "file_path": "b.png", "w": 30}]}
    first, second = load_cameras(with_json(tmp_path, document))
    assert (first.fx, first.fy, first.width, second.width, second.height) == (70.0, 70.0, 20, 30, 50)


GOOD_FRAME = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
BAD_TRANSFORMS = {
    "no size": ({"fl_x": 50, "frames": [GOOD_FRAME]}, "image size"),
    "no focal length": ({"w": 9, "h": 9, "frames": [GOOD_FRAME]}, "fl_x or camera_angle_x"),
    "distortion": ({"fl_x": 5, "w": 9, "h": 9, "k1": 0.1, "frames": [GOOD_FRAME]}, r"k1 = 0\.1.*undistorter"),
    "fisheye": ({"camera_model": "OPENCV_FISHEYE", "frames": [GOOD_FRAME]}, "OPENCV_FISHEYE"),
    "no frames": ({"w": 9}, r"'frames' \(nerfstudio\) or a list of cameras.*got an object with w"),
    "empty frames": ({"frames": []}, "document.json cameras: expected at least one view"),
    "frames of numbers": ({"frames": [1]}, "list of objects"),
    "no path": ({"frames": [{}]}, "'file_path'"),
    "no matrix": ({"fl_x": 5, "w": 9, "h": 9, "frames": [{"file_path": "a"}]}, "matrix"),
    "NaN": ({"fl_x": math.nan, "w": 9, "h": 9, "frames": [GOOD_FRAME]}, "a finite number, got nan"),
    "huge": ({"fl_x": 10**400, "w": 9, "h": 9, "frames": [GOOD_FRAME]}, "a finite number"),
    "text": ({"fl_x": "50", "w": 9, "h": 9, "frames": [GOOD_FRAME]}, "a finite number"),
    "half a pixel": ({"fl_x": 5, "w": 9.5, "h": 9, "frames": [GOOD_FRAME]}, "whole number of pixels"),
    "angle": ({"camera_angle_x": 4, "w": 9, "h": 9, "frames": [GOOD_FRAME]}, "an angle"),
    "zero focal length": ({"fl_x": 0, "fl_y": 5, "w": 9, "h": 9, "frames": [GOOD_FRAME]}, "positive focal"),
    "scaled": (
        {
            "fl_x": 5,
            "w": 9,
            "h": 9,
            "frames": [{"file_path": "a", "transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}],
        },
        "document.json camera 'a' pose: expected a proper rotation, got a rotation scaled by 2",
    ),
    "sheared": (
        {
            "fl_x": 5,
            "w": 9,
            "h": 9,
            "frames": [{"file_path": "a", "transform_matrix": np.diag([4.0, 2, 1, 1]).tolist()}],
        },
        "expected a proper rotation, got a matrix off by",
    ),
    "short row": (
        {"fl_x": 5, "w": 9, "h": 9, "frames": [{**GOOD_FRAME, "transform_matrix": [*np.eye(4).tolist()[:3], [1]]}]},
        "4x4 matrix as nested lists",
    ),
    "homogeneous": (
        {"fl_x": 5, "w": 9, "h": 9, "frames": [{**GOOD_FRAME, "transform_matrix": (2 * np.eye(4)).tolist()}]},
        "0 0 0 1 as the last row, got 0 0 0 2",
    ),
    "listed distortion": (
        {"fl_x": 5, "w": 9, "h": 9, "distortion_params": [0, 0.02], "frames": [GOOD_FRAME]},
        r"distortion_params\[1\] = 0\.02.*OpenCV",
    ),
    "a frame's listed distortion": (
        {"fl_x": 5, "w": 9, "h": 9, "frames": [{**GOOD_FRAME, "distortion_params": [0.1]}]},
        r"distortion_params\[0\] = 0\.1",
    ),
    "shared distortion beside a frame's zero": (
        {"fl_x": 5, "w": 9, "h": 9, "k1": 0.1, "frames": [{**GOOD_FRAME, "k1": 0}]},
        r"k1 = 0\.1",
    ),
    "distortion that is no list": (
        {"fl_x": 5, "w": 9, "h": 9, "distortion_params": "k1", "frames": [GOOD_FRAME]},
        "a list of numbers, got 'k1'",
    ),
    "f-theta": ({"fl_x": 5, "w": 9, "h": 9, "ftheta_p0": 1.5, "frames": [GOOD_FRAME]}, "got ftheta_p0"),
    "panorama": ({"fl_x": 5, "w": 9, "h": 9, "equirectangular": True, "frames": [GOOD_FRAME]}, "equirectangular"),
    "another name of the focal length": (
        {"fx": 5, "w": 9, "h": 9, "frames": [GOOD_FRAME]},
        "neither, but 'fx'; add the focal length in pixels as fl_x",
    ),
}


@pytest.mark.parametrize("case", BAD_TRANSFORMS)
def test_bad_transforms_are_refused(case: str, tmp_path: Path) -> None:
    document, message = BAD_TRANSFORMS[case]
    with pytest.raises(InvalidCameras, match=message):
        load_cameras(with_json(tmp_path, document))


def test_inria_cameras_survive_a_round_trip(model: Path, tmp_path: Path) -> None:
    centred = Cameras(
        tuple(
            Camera(view.name, 640, 480, view.fx, view.fy, 320.0, 240.0, view.world_to_camera)
            for view in load_cameras(model)
        )
    )
    write_inria_cameras(centred, tmp_path / "cameras.json")
    assert_same(load_cameras(tmp_path / "cameras.json"), centred)
    assert_same(load_cameras(tmp_path), centred)


def test_inria_format_refuses_a_principal_point_off_the_centre(model: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidCameras, match="frame 1"):
        write_inria_cameras(load_cameras(model), tmp_path / "cameras.json")
    assert not (tmp_path / "cameras.json").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[{}]", "'img_name'"),
        (b'[{"img_name": "a"}]', "'width'"),
        (b"[3]", r"'img_name' \(Inria\), got a list of int"),
        (b'[{"file_path": "a"}]', "got a list of objects with file_path"),
        (b"version https://git-lfs.github.com/spec/v1\n", "a Git LFS pointer.*git lfs pull"),
        (b"[]", "at least one view"),
        (b"[" * 100_000, "does not parse"),
        (b"{broken", "does not parse"),
        (b"[" + b"1" * 5000 + b"]", "does not parse"),
        (b"", "an empty file"),
        (b"hello", "begins with b'hello'"),
        (b"[\xff\xfe]", "does not parse"),
    ],
)
def test_malformed_json_is_refused(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_bytes(content)
    with pytest.raises(InvalidCameras, match=message) as caught:
        load_cameras(path)
    assert len(str(caught.value)) < 600


def test_large_json_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_file, "MAX_JSON_BYTES", 100)
    with pytest.raises(InvalidCameras, match="at most 100 bytes"):
        load_cameras(with_json(tmp_path, [1] * 200))


def test_what_is_no_camera_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidCameras, match="no such file"):
        load_cameras(tmp_path / "nowhere")
    with pytest.raises(InvalidCameras, match="a folder without any of them"):
        load_cameras(tmp_path)


def test_pickled_splats_are_refused_unopened(tmp_path: Path) -> None:
    with pytest.raises(InvalidSplats, match="may run code"):
        load_splats(tmp_path / "ckpt.pt")


def test_real_cameras_agree_in_both_formats(shared_data: Path) -> None:
    one = load_cameras(shared_data / "plush" / "cameras.json")
    other = load_cameras(shared_data / "plush" / "sparse" / "0")
    assert len(one) == 97
    names = sorted(view.name for view in one)
    assert_same(Cameras(tuple(map(one.get, names))), Cameras(tuple(map(other.get, names))))
    assert len(load_cameras(shared_data / "tabletop")) == 60
