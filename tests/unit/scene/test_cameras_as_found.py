"""Camera files as public repositories have them: what is meant is read, or the next step is said."""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from colmap_files import CAMERAS, IMAGES, binary_files, text_files, write_files

from liftcore.errors import InvalidCameras
from liftcore.io.cameras import MODEL_FOLDERS, other_models, read_cameras
from liftcore.io.inspect import inspect_file

if TYPE_CHECKING:
    from collections.abc import Callable

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
