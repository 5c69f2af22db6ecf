"""Camera files: all formats mean the same; what is meant is read, or the next step is said."""

from __future__ import annotations

import json
import math
import re
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import CAMERAS, IMAGES, assert_same, binary_files, text_files, write_files

from liftcore.errors import InvalidCameras
from liftcore.io import cameras, json_file
from liftcore.io.cameras import MODEL_FOLDERS, other_models, read_cameras
from liftcore.io.inria import write_inria_cameras
from liftcore.io.inspect import describe_camera_file, inspect_file
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


LENS = {2: (2, "SIMPLE_RADIAL", (500.0, 320.0, 240.0, 0.1))}  # distorted
DISTORTED = {**CAMERAS, 1: LENS[2]}
TRANSFORMS = {
    "fl_x": 5,
    "w": 9,
    "h": 9,
    "frames": [{"file_path": "a.png", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}],
}
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 8322710\n"


def zipped(root: Path, folder: str) -> Path:
    """A zip beside a folder, of one folder in it."""
    return Path(shutil.make_archive(f"{root}-zipped", "zip", root, folder))


def names(path: Path) -> list[str]:
    return list(read_cameras(path))


@pytest.mark.parametrize("place", ["dense/0/sparse", "dense/sparse"])
@pytest.mark.parametrize("packed", [False, True])
def test_undistorted_model_of_colmap_is_found(place: str, packed: bool, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    write_files(scene / place, binary_files())
    write_files(scene / "distorted/sparse/0", binary_files(DISTORTED))
    path = tmp_path / shutil.make_archive(str(scene), "zip", scene) if packed else scene
    assert len(names(path)) == 3
    assert other_models(path) == ["distorted/sparse/0"]


def one_view(place: str) -> dict[str, bytes]:
    """A model of one image, named after where it lies."""
    return binary_files(images=[(*IMAGES[0][:3], f"{place.replace('/', '-').replace('.', 'here')}.jpg")])


@pytest.mark.parametrize(
    "places",
    [MODEL_FOLDERS[first:] for first in range(len(MODEL_FOLDERS))]
    + [
        ("sparse", "old/sparse/0"),
        (".", "a/sparse/0"),
        ("dense/sparse", "a/sparse/0"),
        ("0", "a/sparse", "a/sparse/0"),
    ],
)
def test_folder_and_zip_read_the_same_model(places: tuple[str, ...], tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    for place in places:
        write_files(scene / place, one_view(place))
    expected = [places[0].replace("/", "-").replace(".", "here")]
    for path in (scene, zipped(scene, "."), zipped(tmp_path, "scene")):
        assert names(path) == expected
    assert other_models(zipped(scene, ".")) == other_models(scene)
    assert sorted(other_models(scene)) == sorted(places[1:])


@pytest.mark.parametrize("packed", [False, True])
def test_distorted_cameras_beside_undistorted_ones_are_refused(packed: bool, tmp_path: Path) -> None:
    scene = tmp_path / "scene"

    def given() -> Path:
        return tmp_path / shutil.make_archive(str(scene), "zip", scene) if packed else scene

    write_files(scene / "sparse/0", binary_files(DISTORTED))
    assert len(read_cameras(given()).distorted) == 2
    write_files(scene / "sparse/1", binary_files(DISTORTED))  # COLMAP's second component, of the same lens
    write_files(scene / "sparse/2", {**binary_files(), "images.bin": b"cut"})
    assert len(read_cameras(given()).distorted) == 2
    write_files(scene / "dense/0/sparse", binary_files())
    how = "zip the one alone" if packed else "name the one"
    both = rf"distorted ones in (.*/)?sparse/0 and undistorted ones in (.*/)?dense/0/sparse; {how} whose photos"
    with pytest.raises(InvalidCameras, match=both):
        read_cameras(given())
    if not packed:
        assert len(read_cameras(scene / "sparse/0").distorted) == 2
        assert read_cameras(scene / "dense/0/sparse").distorted == ()


def test_distorted_photos_are_told(tmp_path: Path) -> None:
    found = inspect_file(write_files(tmp_path / "model", binary_files(DISTORTED)))
    assert found["distorted"] == 2
    assert found["sizes"] == ["640x480"]  # of the photos
    assert any(
        re.search(
            "2 of 3 views are of distorted photos, of each of which 9[0-9]% or more is lifted: features must be", text
        )
        for text in found["warnings"]
    )
    assert inspect_file(write_files(tmp_path / "plain", binary_files()))["distorted"] == 0


@pytest.mark.parametrize("key", ["applied_transform", "ply_file_path"])
def test_the_frame_of_nerfstudio_is_told(key: str, tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text(json.dumps(TRANSFORMS))
    assert inspect_file(tmp_path)["warnings"] == []
    (tmp_path / "transforms.json").write_text(json.dumps({**TRANSFORMS, key: "sparse_pc.ply"}))
    for path in (tmp_path, tmp_path / "transforms.json"):
        assert any("--orientation-method none" in warning for warning in inspect_file(path)["warnings"])


def test_whole_model_is_preferred_to_half_a_binary_one(tmp_path: Path) -> None:
    folder = write_files(tmp_path / "model", {"cameras.bin": binary_files()["cameras.bin"], **text_files()})
    assert len(names(folder)) == 3


@pytest.mark.parametrize("files", [binary_files, text_files])
def test_model_is_inspected_by_either_of_its_files(files: Callable[[], dict[str, bytes]], tmp_path: Path) -> None:
    write_files(tmp_path, files())
    for name in files():
        assert inspect_file(tmp_path / name)["views"] == 3


def test_json_is_preferred_to_half_a_model(tmp_path: Path) -> None:
    write_files(tmp_path, {"cameras.txt": text_files()["cameras.txt"]})
    (tmp_path / "transforms.json").write_text(json.dumps(TRANSFORMS))
    assert names(tmp_path) == ["a"]


@pytest.mark.parametrize(("there", "missing"), [("cameras.bin", "images.bin"), ("images.bin", "cameras.bin")])
@pytest.mark.parametrize("named", [False, True])
def test_missing_half_of_a_model_is_told(there: str, missing: str, named: bool, tmp_path: Path) -> None:
    write_files(tmp_path, {there: binary_files()[there]})
    with pytest.raises(InvalidCameras, match=f"the file {missing}, got a folder without it"):
        read_cameras(tmp_path / there if named else tmp_path)


def test_hidden_and_broken_models_are_not_told(tmp_path: Path) -> None:
    for place in ("sparse/0", ".cache/sparse/0", "a/b/c/d/e"):
        write_files(tmp_path / place, binary_files())
    write_files(tmp_path / "sparse/1", {"cameras.bin": binary_files()["cameras.bin"]})
    assert other_models(tmp_path) == []


def test_folder_without_a_usual_name_says_what_can_be_named(tmp_path: Path) -> None:
    (tmp_path / "transforms_train.json").write_text("{}")
    with pytest.raises(InvalidCameras, match=r"name what is meant, such as .*transforms_train\.json"):
        read_cameras(tmp_path)
    with pytest.raises(InvalidCameras, match=r"a folder without any of them$"):
        read_cameras(write_files(tmp_path / "empty", {}))


def test_camera_that_no_image_uses_may_be_of_any_model(tmp_path: Path) -> None:
    for files in (binary_files, text_files):
        assert len(names(write_files(tmp_path / files.__name__, files({**CAMERAS, **LENS})))) == 3
    unknown = text_files({**CAMERAS, 3: (99, "CROOKED", (1.0, 2.0))})  # of a binary one nobody knows the length
    assert len(names(write_files(tmp_path / "unknown", unknown))) == 3


def test_byte_order_mark_in_a_text_model_is_no_camera(tmp_path: Path) -> None:
    files = {name: b"\xef\xbb\xbf" + content for name, content in text_files().items()}
    assert len(names(write_files(tmp_path / "model", files))) == 3


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("part", ["cameras", "images"])
def test_pointers_of_git_lfs_are_told(kind: str, part: str, tmp_path: Path) -> None:
    files = binary_files() if kind == "bin" else text_files()
    folder = write_files(tmp_path / "model", {**files, f"{part}.{kind}": POINTER})
    with pytest.raises(InvalidCameras, match=rf"{part}\.{kind}: .*Git LFS pointer.*git lfs pull"):
        read_cameras(folder)


@pytest.mark.parametrize("root", ["sparse\\0\\", "./sparse/0/", ".\\sparse\\0\\"])
def test_zip_with_other_separators_is_read(root: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "scene.zip", "w") as archive:
        for name, content in binary_files().items():
            member = zipfile.ZipInfo("x")
            member.filename = f"{root}{name}"  # as Compress-Archive of PowerShell 5 writes them
            archive.writestr(member, content)
    assert len(names(tmp_path / "scene.zip")) == 3
    assert other_models(tmp_path / "scene.zip") == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("sparse/0/cameras.bin", r"got 'sparse/0/cameras\.bin' without 'images\.bin'; zip both"),
        ("images.txt", r"got 'images\.txt' without 'cameras\.txt'; zip both"),
        ("data/transforms.json", r"got 'data/transforms\.json'; give the JSON file itself, or zip it with"),
        ("photo.jpg", r"got none; zip the folder that has cameras\.bin"),
    ],
)
def test_zip_without_a_model_says_what_it_has(name: str, message: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "scene.zip", "w") as archive:
        archive.writestr(name, b"")
    with pytest.raises(InvalidCameras, match=message):
        read_cameras(tmp_path / "scene.zip")


def test_one_file_of_a_model_is_told_to_come_with_the_other(tmp_path: Path) -> None:
    path = tmp_path / "upload"
    path.write_bytes(binary_files()["cameras.bin"])
    with pytest.raises(InvalidCameras, match=r"a zip of its cameras\.\* and images\.\* together"):
        read_cameras(path)


def test_views_of_one_name_say_what_to_do(tmp_path: Path) -> None:
    record = {"img_name": "r_0", "width": 9, "height": 9, "fx": 5, "fy": 5, "position": [0, 0, 0]}
    record["rotation"] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    (tmp_path / "cameras.json").write_text(json.dumps([record, record]))
    with pytest.raises(InvalidCameras, match=r"cameras\.json cameras: expected one view a name.*test views first"):
        read_cameras(tmp_path)


def test_what_is_wrong_with_a_view_of_a_model_names_the_model(tmp_path: Path) -> None:
    images = [(1, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, place), "a.jpg") for place in (1.0, 2.0)]
    folder = write_files(tmp_path / "model", binary_files(images=images))
    with pytest.raises(InvalidCameras, match=r"model cameras: expected one view a name, got 'a' twice; .*train/r_0"):
        read_cameras(folder)


def test_distortion_that_is_no_number_is_told(tmp_path: Path) -> None:
    files = text_files({**CAMERAS, 1: (2, "SIMPLE_RADIAL", (500.0, 320.0, 240.0, float("nan")))})
    with pytest.raises(InvalidCameras, match="camera 1: expected finite k1, got nan"):
        read_cameras(write_files(tmp_path / "model", files))


def test_zip_of_damaged_lzma_is_told(tmp_path: Path) -> None:
    path = tmp_path / "scene.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        for name, content in binary_files().items():
            archive.writestr(name, content * 50)
    content = bytearray(path.read_bytes())
    content[60:100] = bytes(40)
    path.write_bytes(content)
    with pytest.raises(InvalidCameras, match="a zip of a COLMAP sparse model, got one that does not open"):
        read_cameras(path)
