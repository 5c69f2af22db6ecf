"""How views are named in all formats, how they pair with features, and what is said of a name that none has."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from camera_documents import transforms_of, with_json
from colmap_files import CAMERAS, IMAGES, binary_files, text_files, write_files

from liftcore.errors import InvalidCameras, NotFound
from liftcore.io.cameras import read_cameras
from liftcore.io.inria import write_inria_cameras
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.views import cameras_of_views, view_names


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return write_files(tmp_path / "model", binary_files())


def test_views_are_named_by_stem_and_all_by_path_where_any_stems_collide() -> None:
    images = ["a/001.jpg", "b\\002.png", "003.JPG", "./train/r_0", "frame.0001"]
    assert view_names(images) == ["001", "002", "003", "r_0", "frame.0001"]
    assert view_names([*images, "b/001.jpg"]) == ["a/001", "b/002", "003", "train/r_0", "frame.0001", "b/001"]


RIG = [f"camA/{k:03}.jpg" for k in range(4)] + [f"camB/{k:03}.jpg" for k in range(3)]


@pytest.mark.parametrize("kind", ["folder", "text", "zip", "transforms", "inria"])
def test_every_view_of_a_rig_keeps_its_folder_in_every_format(kind: str, tmp_path: Path) -> None:
    images = [(*IMAGES[0][:3], name) for name in RIG]
    path = write_files(tmp_path / "rig", (text_files if kind == "text" else binary_files)(images=images))
    if kind == "zip":
        path = Path(shutil.make_archive(str(path), "zip", path))
    elif kind == "transforms":
        path = with_json(tmp_path, transforms_of(read_cameras(path)))
    elif kind == "inria":
        cameras = [view.replace(cx=view.width / 2, cy=view.height / 2) for view in read_cameras(path).values()]
        path = tmp_path / "cameras.json"
        write_inria_cameras(Cameras(cameras), path)
    names = [name.removeprefix("images/") for name in read_cameras(path)]
    assert names == [name.removesuffix(".jpg") for name in RIG]


def test_unknown_view_names_its_neighbours(model: Path) -> None:
    cameras = read_cameras(model)
    assert len(cameras) == len(CAMERAS) + 1
    with pytest.raises(NotFound, match="frame_2"):
        cameras["frame_3"]


def test_a_view_is_found_by_its_last_part_where_that_is_clear() -> None:
    """Lifts of before name the views of a rig that are alone with their number without its folder."""
    pose = np.eye(4)
    names = ("images/camA/000", "images/camB/000", "images/camA/001")
    cameras = Cameras(tuple(Camera.pinhole(name, 4, 4, 5.0, 5.0, 2.0, 2.0, pose) for name in names))
    assert cameras["001"].name == cameras["camA/001"].name == "images/camA/001"
    for unclear in ("000", "camB/001", "images/camB/001"):
        with pytest.raises(NotFound):
            cameras[unclear]


def test_a_long_unknown_name_gets_a_short_answer() -> None:
    pose = np.eye(4)
    far = [Camera.pinhole(f"{k:06}" + "x" * 300, 4, 4, 5.0, 5.0, 2.0, 2.0, pose) for k in range(20)]
    with pytest.raises(NotFound, match="nearest:") as caught:
        Cameras(far)["000001" + "y" * 494]
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("kind", ["binary", "text", "transforms", "inria"])
def test_more_views_than_a_scene_may_have_are_refused_before_they_are_read(
    kind: str, tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("liftcore.scene.cameras.MAX_VIEWS", 2)
    path = write_files(tmp_path / "many", (text_files if kind == "text" else binary_files)())
    if kind == "binary":
        announced = struct.pack("<Q", 3) + b"\0" * 3 * 73  # nothing that could be read
        path = write_files(tmp_path / "many", {"images.bin": announced})
    elif kind == "transforms":
        path = with_json(tmp_path, {"frames": [{}] * 3})
    elif kind == "inria":
        path = with_json(tmp_path, [{"img_name": "a"}] * 3)
    with pytest.raises(InvalidCameras, match=r"at most 2 views, got 3 or more; lift fewer photos"):
        read_cameras(path)


def test_announced_bombs_of_empty_images_are_refused(tmp_path: Path) -> None:
    images = struct.pack("<Q", 300_000) + b"\0" * 300_000 * 73
    path = write_files(tmp_path / "bomb", {**binary_files(), "images.bin": images})
    with pytest.raises(InvalidCameras, match=r"images\.bin: expected at most 100000 views, got 300000 or more"):
        read_cameras(path)


@pytest.mark.parametrize(
    ("views", "cameras", "pairs"),
    [
        (["a", "b"], ["b", "c"], {"b": "b"}),
        (["camA/0", "camB/1"], ["0", "1"], {"camA/0": "0", "camB/1": "1"}),  # the scene's names were all unique
        (["0", "1"], ["camA/0", "camA/1", "camB/0"], {"1": "camA/1"}),  # nobody knows which 0 is meant
        (["camA/0", "camB/0"], ["0"], {}),
        (["0", "camA/0"], ["0"], {"0": "0"}),  # the same name comes first
        (["camA/0"], ["images/camA/0"], {"camA/0": "images/camA/0"}),
        (["images/camA/0"], ["camA/0"], {"images/camA/0": "camA/0"}),
        (["train/0"], ["test/0"], {}),  # folders that disagree are other photos
        (["A/0"], ["camA/0"], {}),  # whole folders only
    ],
)
def test_names_pair_as_they_are_or_by_their_last_part_where_it_is_one_of_a_kind(
    views: list[str], cameras: list[str], pairs: dict[str, str]
) -> None:
    assert cameras_of_views(views, cameras) == pairs
    back = {camera: view for view, camera in pairs.items()}
    assert cameras_of_views(cameras, views) == back
