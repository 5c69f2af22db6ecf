"""Camera files: all formats give the same cameras, and every error names a remedy."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from liftcore.errors import InvalidCameras, InvalidFeatures
from liftcore.evaluate.inspect import inspect_file
from liftcore.io.cameras import read_cameras
from liftcore.scene.views import require_pairs
from tests.camera_files import CAMERAS, binary_files, text_files, with_json, write_files

DISTORTED = {**CAMERAS, 1: (2, "SIMPLE_RADIAL", (500.0, 320.0, 240.0, 0.1))}
FRAME = {"file_path": "a.png", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}
TRANSFORMS = {"fl_x": 5, "w": 9, "h": 9, "frames": [FRAME]}


POSE = {"position": [0, 0, 0], "rotation": np.eye(3).tolist()}
RECORD = {"img_name": "r_0", "width": 9, "height": 9, "fx": 5, "fy": 5} | POSE


def names(path: Path) -> list[str]:
    return list(read_cameras(path))


def zipped(root: Path, folder: str) -> Path:
    """Write a zip of one folder within a folder, next to it."""
    return Path(shutil.make_archive(f"{root}-zipped", "zip", root, folder))


def named_model(*names: str) -> dict[str, bytes]:
    """Return the files of a model of images with these names, at distinct positions."""
    return binary_files(
        images=[(1, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, float(k)), name) for k, name in enumerate(names)]
    )


ALL = [f"IMG_{k}.jpg" for k in range(6)]


@pytest.mark.parametrize(
    "place", [".", "sparse/0", "sparse/3", "sparse", "colmap/sparse/1", "7", "dense/0/sparse", "dense/sparse"]
)
def test_folder_and_zip_read_the_same_model(place: str, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    write_files(scene / place, named_model(*ALL))
    write_files(scene / "distorted/sparse/0", named_model("other.jpg"))  # as 3DGS's convert.py leaves it
    write_files(scene / "sparse/9", {"cameras.bin": b"of no whole model"})
    for path in (scene, zipped(scene, "."), zipped(tmp_path, "scene")):
        assert len(read_cameras(path)) == len(ALL) and read_cameras(path).warnings == ()


def test_what_is_whole_is_preferred_and_what_is_named_is_read(tmp_path: Path) -> None:
    folder = write_files(tmp_path / "model", {"cameras.bin": binary_files()["cameras.bin"], **text_files()})
    for path in (folder, folder / "images.txt", folder / "cameras.txt"):
        assert inspect_file(path)["views"] == 3
    with_json(tmp_path, TRANSFORMS).rename(folder / "transforms.json")
    assert names(folder / "transforms.json") == ["a"] and len(names(folder)) == 3
    (folder / "images.txt").unlink()
    assert names(folder) == ["a"]


def test_folder_without_a_usual_name_says_what_can_be_named(tmp_path: Path) -> None:
    (tmp_path / "transforms_test.json").write_text("{}")
    with pytest.raises(InvalidCameras, match=r"name one of the files, such as .*transforms_test\.json"):
        read_cameras(tmp_path)
    with pytest.raises(InvalidCameras, match=r"a folder without any of them$"):
        read_cameras(write_files(tmp_path / "empty", {}))
    with pytest.raises(InvalidCameras, match="no such file"):
        read_cameras(tmp_path / "nowhere")


def test_camera_that_no_image_uses_may_be_of_any_model(tmp_path: Path) -> None:
    for files in (binary_files, text_files):
        assert len(names(write_files(tmp_path / files.__name__, files({**CAMERAS, 2: DISTORTED[1]})))) == 3
    unknown = text_files({**CAMERAS, 3: (99, "CROOKED", (1.0, 2.0))})  # a binary one would have an unknown length
    assert len(names(write_files(tmp_path / "unknown", unknown))) == 3
    files_with_bom = {name: b"\xef\xbb\xbf" + content for name, content in text_files().items()}
    assert len(names(write_files(tmp_path / "marked", files_with_bom))) == 3  # and a byte order mark is none


def test_image_names_that_are_no_utf8_give_a_warning(tmp_path: Path) -> None:
    files = {name: content.replace(b"K?c", b"K\xfcc") for name, content in named_model("K?che_0", "K?che_1").items()}
    cameras = read_cameras(write_files(tmp_path, files))
    assert len(cameras) == 2 and "2 images are not UTF-8" in " ".join(cameras.warnings)
    with pytest.raises(InvalidFeatures, match="names of cameras are not UTF-8"):
        require_pairs(["K\u00fcche_0", "K\u00fcche_1"], cameras)


def test_centres_that_successors_of_inrias_trainer_write_are_read(tmp_path: Path) -> None:
    camera = read_cameras(with_json(tmp_path, [{**RECORD, "cx": 3, "cy": 4.5}]))["r_0"]
    assert (camera.cx, camera.cy) == (3, 4.5)


def test_broken_poses_of_json_are_named_and_the_others_are_read(tmp_path: Path) -> None:
    good = {**RECORD, "img_name": "good.png"}
    records = [
        good,
        {**good, "img_name": "a", "rotation": [[2, 0, 0]] * 3},
        {**good, "img_name": "b", "position": None},
    ]
    still = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    poses = {"a": [[2.0, 0, 0, 0], *FRAME["transform_matrix"][1:]], "b": None, "c": [[math.nan] * 4] * 3, "d": still}
    frames = [{**FRAME, "file_path": "good.png"}]
    frames += [{"file_path": name, "transform_matrix": pose} for name, pose in poses.items()]
    for document, skipped_count in ((records, 2), ({**TRANSFORMS, "frames": frames}, 4)):
        path = with_json(tmp_path, document)
        assert names(path) == ["good"]
        [warning] = read_cameras(path).warnings
        assert f"{skipped_count} cameras were skipped" in warning and "'a', 'b'" in warning
    with pytest.raises(InvalidCameras, match="'fx'"):  # what is wrong elsewhere is refused
        read_cameras(with_json(tmp_path, [good, {key: value for key, value in good.items() if key != "fx"}]))
