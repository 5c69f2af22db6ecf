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
from camera_documents import assert_same
from colmap_files import IMAGES, binary_files, text_files, write_files

from liftcore.errors import InvalidCameras
from liftcore.io import cameras, json_file
from liftcore.io.cameras import other_models, read_cameras
from liftcore.io.inria import write_inria_cameras
from liftcore.io.inspect import describe_camera_file
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.distortion import Brown, Fisheye, Lens


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return write_files(tmp_path / "model", binary_files())


def test_binary_and_text_models_mean_the_same(model: Path, tmp_path: Path) -> None:
    assert_same(read_cameras(model), read_cameras(write_files(tmp_path / "text", text_files())))


def test_colmap_poses_are_world_to_camera(model: Path) -> None:
    cameras = read_cameras(model)
    assert list(cameras) == ["frame 1", "frame_2", "frame.0003"]
    first, second, third = cameras.values()
    assert (first.fx, first.fy, first.cx, first.cy) == (500.0, 510.0, 320.5, 239.5)
    assert (second.fx, second.fy) == (400.0, 400.0)
    assert np.allclose(first.centre, [0, 0, -2])
    assert np.allclose(second.viewmat[:3, :3] @ [1, 0, 0], [0, 1, 0])  # a third of a turn about (1, 1, 1)
    assert np.allclose(third.viewmat[:3, :3], np.diag([-1, 1, -1]))  # the quaternion is normalised


@pytest.mark.parametrize("place", [".", "sparse/0", "sparse", "0"])
def test_model_is_found_in_a_scene_folder(place: str, tmp_path: Path, model: Path) -> None:
    write_files(tmp_path / "scene" / place, binary_files())
    assert_same(read_cameras(tmp_path / "scene"), read_cameras(model))


@pytest.mark.parametrize("root", ["", "scene/sparse/0/", "../../"])
@pytest.mark.parametrize("files", [binary_files, text_files])
def test_zipped_model_is_read_at_any_depth(root: str, files: Any, tmp_path: Path, model: Path) -> None:
    path = tmp_path / "upload.bin"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{root}points3D.bin", b"never read")
        for name, content in files().items():
            archive.writestr(root + name, content)
    before = sorted(tmp_path.rglob("*"))
    assert_same(read_cameras(path), read_cameras(model))
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
    monkeypatch.setattr(cameras, "MAX_UNZIPPED_BYTES", 1000)
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("cameras.bin", bytes(100_000))
        archive.writestr("images.bin", b"")
    with pytest.raises(InvalidCameras, match="at most 1000 bytes unzipped"):
        read_cameras(path)
    monkeypatch.setattr(cameras, "MAX_ZIP_MEMBERS", 1)
    with pytest.raises(InvalidCameras, match="at most 1 files, got 2"):
        read_cameras(path)


def test_error_in_a_zip_names_the_zip(tmp_path: Path) -> None:
    path = tmp_path / "short.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("cameras.bin", binary_files()["cameras.bin"])
        archive.writestr("images.bin", b"")
    with pytest.raises(InvalidCameras) as caught:
        read_cameras(path)
    assert str(caught.value).startswith(f"{path}/images.bin")


@pytest.mark.parametrize(
    ("number", "name", "parameters", "distortion"),
    [
        (2, "SIMPLE_RADIAL", (500.0, 320.0, 240.0), (0.01,)),
        (3, "RADIAL", (500.0, 320.0, 240.0), (0.01, -0.02)),
        (4, "OPENCV", (500.0, 500.0, 320.0, 240.0), (0.01, -0.02, 0.001, 0.002)),
        (6, "FULL_OPENCV", (500.0, 500.0, 320.0, 240.0), (0.01, -0.02, 0.001, 0.002, 0.03, 0.004, 0.005, 0.006)),
    ],
)
def test_perspective_models_are_pinholes_without_distortion_and_have_a_lens_with_it(
    number: int, name: str, parameters: tuple[float, ...], distortion: tuple[float, ...], tmp_path: Path
) -> None:
    lens = Brown(**dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), distortion, strict=False)))
    for files in (binary_files, text_files):
        sensor = {1: (number, name, (*parameters, *[0.0] * len(distortion)))}
        straight = read_cameras(write_files(tmp_path / files.__name__, files(sensor, IMAGES[:1])))
        assert straight.distorted == ()
        assert (straight["frame 1"].fx, straight["frame 1"].fy, straight["frame 1"].cx) == (500.0, 500.0, 320.0)
        sensor = {1: (number, name, (*parameters, *distortion))}
        bent = read_cameras(write_files(tmp_path / files.__name__, files(sensor, IMAGES[:1])))
        assert bent.distorted == ("frame 1",)
        assert bent["frame 1"].lens == Lens(640, 480, 500.0, 500.0, 320.0, 240.0, lens)


@pytest.mark.parametrize(
    ("number", "name", "parameters", "k"),
    [
        (5, "OPENCV_FISHEYE", (500.0, 510.0, 320.0, 240.0, 0.1, 0.02, 0.003, 0.0), (0.1, 0.02, 0.003, 0.0)),
        (5, "OPENCV_FISHEYE", (500.0, 510.0, 320.0, 240.0, *[0.0] * 4), (0.0,) * 4),
        (8, "SIMPLE_RADIAL_FISHEYE", (500.0, 320.0, 240.0, 0.1), (0.1, 0.0, 0.0, 0.0)),
        (9, "RADIAL_FISHEYE", (500.0, 320.0, 240.0, 0.1, 0.02), (0.1, 0.02, 0.0, 0.0)),
        (14, "SIMPLE_FISHEYE", (500.0, 320.0, 240.0), (0.0,) * 4),
        (15, "FISHEYE", (500.0, 510.0, 320.0, 240.0), (0.0,) * 4),
    ],
)
def test_a_fisheye_always_has_a_lens(
    number: int, name: str, parameters: tuple[float, ...], k: tuple[float, ...], tmp_path: Path
) -> None:
    for files in (binary_files, text_files):
        sensor = {1: (number, name, parameters)}
        [view] = read_cameras(write_files(tmp_path / files.__name__, files(sensor, IMAGES[:1]))).values()
        assert view.lens is not None
        assert view.lens.distortion == Fisheye(*k)
        assert (view.lens.fx, view.lens.cx, view.lens.cy) == (500.0, 320.0, 240.0)


@pytest.mark.parametrize(
    ("number", "name", "count"),
    [(7, "FOV", 5), (10, "THIN_PRISM_FISHEYE", 12), (11, "RAD_TAN_THIN_PRISM_FISHEYE", 16), (16, "EUCM", 6)],
)
def test_models_that_are_not_read_are_refused(number: int, name: str, count: int, tmp_path: Path) -> None:
    sensor = {1: (number, name, (500.0, 500.0, 320.0, 240.0, *[0.0] * (count - 4)))}
    for files in (binary_files, text_files):
        with pytest.raises(InvalidCameras, match=rf"SIMPLE_PINHOLE, .*, got {name}; .*image_undistorter"):
            read_cameras(write_files(tmp_path / files.__name__, files(sensor, IMAGES[:1])))


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
        read_cameras(write_files(tmp_path, binary_files() | files))
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
        read_cameras(write_files(tmp_path, text_files() | {name: content}))


def test_inria_cameras_survive_a_round_trip(model: Path, tmp_path: Path) -> None:
    centred = Cameras(
        tuple(
            Camera.pinhole(view.name, 640, 480, view.fx, view.fy, 320.0, 240.0, view.viewmat)
            for view in read_cameras(model).values()
        )
    )
    write_inria_cameras(centred, tmp_path / "cameras.json")
    assert_same(read_cameras(tmp_path / "cameras.json"), centred)
    assert_same(read_cameras(tmp_path), centred)


def test_inria_format_refuses_a_principal_point_off_the_centre(model: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidCameras, match="frame 1"):
        write_inria_cameras(read_cameras(model), tmp_path / "cameras.json")
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
        read_cameras(path)
    assert len(str(caught.value)) < 600


def test_large_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    with path.open("wb") as handle:
        handle.write(b"[")
        handle.truncate(json_file.MAX_JSON_BYTES + 1)
    with pytest.raises(InvalidCameras, match="at most 67108864 bytes"):
        read_cameras(path)


def test_what_is_no_camera_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidCameras, match="no such file"):
        read_cameras(tmp_path / "nowhere")
    with pytest.raises(InvalidCameras, match="a folder without any of them"):
        read_cameras(tmp_path)


def test_real_cameras_agree_in_both_formats(shared_data: Path) -> None:
    one = read_cameras(shared_data / "plush" / "cameras.json")
    other = read_cameras(shared_data / "plush" / "sparse" / "0")
    assert len(one) == 97
    names = sorted(one)
    assert_same(Cameras([one[name] for name in names]), Cameras([other[name] for name in names]))
    assert len(read_cameras(shared_data / "tabletop")) == 60


def test_json_beside_a_model_is_read_where_it_is_named(tmp_path: Path) -> None:
    folder = write_files(tmp_path / "model", binary_files())
    write_inria_cameras(
        Cameras((Camera.pinhole("v", 64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4)),)), folder / "cameras.json"
    )
    assert list(read_cameras(folder / "cameras.json")) == ["v"]
    assert "v" not in read_cameras(folder)
