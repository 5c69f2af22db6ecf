"""nerfstudio's files: cameras of a transforms.json, and the frame in which a run trained."""

from __future__ import annotations

import io
import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from liftcore.errors import InvalidCameras
from liftcore.evaluate.inspect import inspect_file
from liftcore.io.cameras import read_cameras
from liftcore.io.transforms import FRAME_FILE, transforms_of
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.distortion import Brown, Fisheye, Lens
from liftcore.values.lift_file import camera_input
from tests.camera_files import assert_same, binary_files, with_json, write_files
from tests.inria_file import write_inria_cameras


def test_frame_intrinsics_come_before_shared_ones(tmp_path: Path) -> None:
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 70.0, "w": 20.0}
    document = {"fl_x": 50.0, "w": 100, "h": 50, "frames": [frame, {**frame, "file_path": "b.png", "w": 30}]}
    first, second = read_cameras(with_json(tmp_path, document)).values()
    assert (first.fx, first.fy, first.width, second.width, second.height) == (70.0, 70.0, 20, 30, 50)


GOOD_FRAME = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
PARAMETERS = {"k1": 0.1, "k2": -0.02, "p1": 0.001, "p2": -0.002}
DISTORTION_PARAMS = [0.1, -0.02, 0.0, 0.0, 0.001, -0.002]
BROWN = Brown(k1=0.1, k2=-0.02, p1=0.001, p2=-0.002)


@pytest.mark.parametrize(
    ("shared", "per_frame", "lens"),
    [
        (PARAMETERS, {}, BROWN),
        ({}, {"distortion_params": DISTORTION_PARAMS, **PARAMETERS}, BROWN),
        ({"k3": 0.1, "camera_model": "OPENCV"}, {}, Brown(k3=0.1)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.01}, {}, Fisheye(k1=0.1, k4=0.01)),
        ({"is_fisheye": True, "k2": 0.1}, {}, Fisheye(k2=0.1)),
        ({"k1": 0, "distortion_params": []}, {"k1": 0.0}, None),
    ],
)
def test_distortion_of_transforms(
    shared: dict[str, Any], per_frame: dict[str, Any], lens: Brown | Fisheye | None, tmp_path: Path
) -> None:
    document = {"fl_x": 90, "fl_y": 80, "w": 100, "h": 64, **shared, "frames": [{**GOOD_FRAME, **per_frame}]}
    [view] = read_cameras(with_json(tmp_path, document)).values()
    assert view.lens == (None if lens is None else Lens(100, 64, 90.0, 80.0, 50.0, 32.0, lens))


APPLIED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])  # of nerfstudio's converter
SCALE = 0.37


def zipped(folder: Path) -> Path:
    return Path(shutil.make_archive(str(folder), "zip", folder))


def oriented() -> np.ndarray:
    """Return the matrix [4, 4] with which a run rotates and centres the poses of its transforms.json."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [20, -35, 70], degrees=True).as_matrix()
    pose[:3, 3] = (0.4, -1.3, 2.2)
    return pose


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return write_files(tmp_path / "model", binary_files())


@pytest.fixture
def run(tmp_path: Path, model: Path) -> Path:
    """Return a folder with the transforms.json of the model's poses, and the file of a run."""
    document = transforms_of(read_cameras(model))
    for record in document["frames"]:
        record["transform_matrix"] = (APPLIED @ np.array(record["transform_matrix"])).tolist()
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "transforms.json").write_text(json.dumps({**document, "applied_transform": APPLIED[:3].tolist()}))
    (folder / FRAME_FILE).write_text(json.dumps({"transform": (oriented() @ APPLIED)[:3].tolist(), "scale": SCALE}))
    return folder


@pytest.fixture
def expected(model: Path) -> Cameras:
    """Return the model's cameras with the poses that nerfstudio trains on: transformed, then scaled."""
    cameras, views = read_cameras(model), []
    for camera, record in zip(cameras.values(), transforms_of(cameras)["frames"], strict=True):
        pose = oriented() @ APPLIED @ np.array(record["transform_matrix"])
        pose[:3, 3] *= SCALE
        views.append(camera.replace(viewmat=np.linalg.inv(pose * [1.0, -1.0, -1.0, 1.0])))  # axes are columns
    return Cameras(views)


def change(path: Path, **changes: Any) -> None:
    """Change values in a JSON file; None removes a key."""
    document = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({key: value for key, value in document.items() if value is not None}))


@pytest.mark.parametrize(
    ("source", "frame", "paths"),  # a model's folder or a transforms.json; where the run's file lies; what is read
    [
        ("transforms.json", ".", ["", "transforms.json", "zip"]),
        ("transforms_train.json", ".", ["transforms_train.json", "zip"]),
        ("transforms.json", "outputs/splatfacto/2026-01-01", ["zip"]),
        (".", ".", ["", "images.bin", "zip"]),
        ("sparse/0", "outputs", ["zip"]),  # of the zip's only model
    ],
)
def test_cameras_are_moved_as_nerfstudio_moves_them(
    source: str, frame: str, paths: list[str], run: Path, model: Path, expected: Cameras, tmp_path: Path
) -> None:
    scene = tmp_path / "scene"
    for folder in (scene / frame, scene / ".ipynb_checkpoints"):
        folder.mkdir(parents=True)
    shutil.copy(run / "transforms.json", scene / ".ipynb_checkpoints")  # which does not count
    shutil.copy(run / FRAME_FILE, scene / frame)
    if source.endswith(".json"):
        shutil.copy(run / "transforms.json", scene / source)
    else:
        shutil.copytree(model, scene / source, dirs_exist_ok=True)
    for path in paths:
        cameras = read_cameras(zipped(scene) if path == "zip" else scene / path)
        assert cameras.frame == FRAME_FILE
        assert_same(cameras, expected)
    assert inspect_file(zipped(scene))["warnings"] == []
    (run / FRAME_FILE).unlink()
    assert read_cameras(run).frame is None
    with pytest.raises(AssertionError):
        assert_same(read_cameras(run), expected)


def test_what_was_applied_before_is_not_applied_twice(run: Path, model: Path, expected: Cameras) -> None:
    change(run / "transforms.json", applied_scale=4.0)
    change(run / FRAME_FILE, scale=4.0 * SCALE)  # what nerfstudio then writes
    assert_same(read_cameras(run), expected)
    change(run / "transforms.json", applied_scale=None, applied_transform=None)  # of poses that are no model's
    change(run / FRAME_FILE, scale=SCALE, transform=oriented()[:3].tolist())
    shutil.copytree(model, run / "colmap/sparse/0")  # with a frame, a transforms.json is preferred
    for path in (run, zipped(run)):
        assert_same(read_cameras(path), expected)


@pytest.mark.parametrize(
    ("file", "key", "value", "message"),
    [
        (FRAME_FILE, "transform", None, "got no 'transform'"),
        (FRAME_FILE, "scale", None, "got no 'scale'"),
        (
            FRAME_FILE,
            "transform",
            np.diag([1.0, 1, -1, 1]).tolist(),
            r"no reflection, got a matrix that mirrors \(determinant -0.05",
        ),
        (FRAME_FILE, "scale", 0, r"a scale in 1e-09\.\.1e\+09 as scale, got 0"),
        (
            "transforms.json",
            "applied_transform",
            np.zeros((3, 4)).tolist(),
            "applied_transform of a rotation times a scale, no reflection",
        ),
    ],
)
def test_frame_that_is_none_is_refused(file: str, key: str, value: Any, message: str, run: Path) -> None:
    change(run / file, **{key: value})
    with pytest.raises(InvalidCameras, match=rf"{file}.*{message}"):
        read_cameras(run)


def test_inria_cameras_are_in_the_frame_of_their_splats(run: Path) -> None:
    camera = Camera.pinhole("a", 9, 9, 5, 5, 4.5, 4.5, np.eye(4))
    (run / "transforms.json").unlink()
    write_inria_cameras(Cameras((camera,)), run / "cameras.json")
    for path in (run, run / "cameras.json"):
        with pytest.raises(InvalidCameras, match=r"cameras in another frame, got Inria's.*; remove .* or "):
            read_cameras(path)


@pytest.mark.parametrize("name", ["", "transforms.json"])
def test_another_frame_is_another_input(name: str, run: Path) -> None:
    before = camera_input(run / name)
    change(run / FRAME_FILE, scale=2 * SCALE)
    assert camera_input(run / name).sha256 != before.sha256
    change(run / FRAME_FILE, scale=SCALE)
    (run / "photo.jpg").write_bytes(b"not read")
    assert camera_input(run / name) == before
    (run / FRAME_FILE).unlink()
    assert camera_input(run / name).sha256 not in (before.sha256, "")


def photo(path: Path, size: tuple[int, int], orientation: int = 1) -> None:
    """Write a photo of noise that, but for WebP, ends early: only its header can be read."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    content = io.BytesIO()
    kind = {"jpg": "JPEG", "jpeg": "JPEG", "png": "PNG", "webp": "WEBP"}[path.suffix[1:].lower()]
    Image.effect_noise(size, 90).convert("RGB").save(content, format=kind, exif=exif)
    data = content.getvalue()
    path.write_bytes(data if kind == "WEBP" else data[: len(data) * 2 // 3])


def blender(*paths: str) -> dict[str, Any]:
    frames = [{"file_path": path, "rotation": 0.01, "transform_matrix": np.eye(4).tolist()} for path in paths]
    return {"camera_angle_x": math.pi / 2, "frames": frames}


@pytest.mark.parametrize(
    ("file_path", "file"),
    [
        ("./train/r_0", "train/r_0.png"),
        ("images/a.jpg", "images/a.JPG"),  # from a system that makes no difference
        ("images\\a.png", "images/a.png"),
        ("../images/a.png", "../images/a.png"),  # colmap2nerf's, of a file in a folder of its own
        ("C:/data/images/a.png", "images/a.png"),
    ],
)
def test_the_size_of_photos_is_in_their_headers(file_path: str, file: str, tmp_path: Path) -> None:
    scene = tmp_path / "scene/nerf"
    photo(scene / file, (30, 20), orientation=6)
    photo(scene / "depth/a.png", (7, 7))
    scene.mkdir(exist_ok=True)
    (scene / "transforms_train.json").write_text(json.dumps(blender(file_path)))
    paths = [scene / "transforms_train.json", scene]
    if not file.startswith(".."):
        paths.append(zipped(scene))
    for path in paths:
        [view] = read_cameras(path).values()
        assert (view.width, view.height) == (30, 20)  # as it is stored: trainers do not turn it
        assert (view.fx, view.fy, view.cx, view.cy) == (pytest.approx(15), pytest.approx(15), 15, 10)


def test_a_principal_point_beyond_its_photo_is_refused(tmp_path: Path) -> None:
    photo(tmp_path / "a.png", (30, 20), orientation=6)
    path = with_json(tmp_path, {**blender("a"), "cx": 30.0, "cy": 20.0})
    with pytest.raises(InvalidCameras, match=r"within the photo of 30x20, got 30\.0, 20\.0; .*made smaller"):
        read_cameras(path)


def test_a_photo_that_is_not_there_is_named(tmp_path: Path) -> None:
    path = with_json(tmp_path, blender("./train/a", "./train/c"))
    photo(tmp_path / "train/a.png", (30, 20))
    with pytest.raises(InvalidCameras, match=r"frame 'c'.*size, w and h, got none, and no photo \S*/train/c \(\.png"):
        read_cameras(path)
    (tmp_path / "train/c.jpg").write_bytes(b"no photo")
    with pytest.raises(InvalidCameras, match=r"frame 'c'.*cannot identify \(\S*/train/c\.jpg\)"):
        read_cameras(path)


def test_photos_elsewhere_than_beside_the_file_are_not_looked_at(tmp_path: Path) -> None:
    photo(tmp_path / "secret/a.png", (30, 20))
    folder = tmp_path / "data/assets/one"
    folder.mkdir(parents=True)
    for outside in (str(tmp_path / "secret/a.png"), "../../../secret/a.png", "x/../../../../secret/a.png"):
        with pytest.raises(InvalidCameras, match="no photo"):
            read_cameras(with_json(folder, blender(outside)))


def test_a_folder_of_train_and_test_reads_train_and_names_the_others(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    for part in ("train", "test", "val"):
        photo(scene / part / "r_0.png", (30, 20))
        (scene / f"transforms_{part}.json").write_text(json.dumps(blender(f"./{part}/r_0")))
    change(scene / "transforms_test.json", camera_angle_x=1.0)
    for path in (scene, zipped(scene)):
        cameras = read_cameras(path)
        assert cameras["r_0"].fx == pytest.approx(15)
        [warning] = cameras.warnings
        assert re.search("transforms_train.json was read, and transforms_test.json, transforms_val.json not", warning)
    assert read_cameras(scene / "transforms_test.json").warnings == ()


def exported(cameras: Cameras, path: Path, **fields: Any) -> Path:
    """Write cameras in the frame of the splats as ``ns-export cameras`` does: camera to world, y up and z back."""
    records = []
    for camera in cameras.values():
        pose = np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
        records.append(
            {"file_path": f"/data/scene/images_2/{camera.name}.jpg", "transform": pose[:3].tolist(), **fields}
        )
    path.write_text(json.dumps(records))
    return path


def test_an_export_has_the_intrinsics_of_the_transforms_beside_it(expected: Cameras, run: Path) -> None:
    """The poses of an export are in the frame of the run's splats already."""
    assert_same(read_cameras(exported(expected, run / "transforms_train.json")), expected)


def test_an_export_without_intrinsics_is_refused_as_what_it_is(expected: Cameras, tmp_path: Path) -> None:
    path = exported(expected, tmp_path / "transforms_train.json")
    with pytest.raises(
        InvalidCameras, match=r"export \(ns-export cameras\), which has poses alone; put the transforms"
    ):
        read_cameras(path)
    fields = {"fl_x": 50.0, "w": 64, "h": 48}
    [view, *_] = read_cameras(exported(expected, path, **fields)).values()
    assert (view.fx, view.fy, view.width, view.cx) == (50.0, 50.0, 64, 32.0)
    of_another = {"frames": [{"file_path": "other.jpg", "fl_x": 5, "w": 9, "h": 9}]}
    exported(expected, path)
    (tmp_path / "transforms.json").write_text(json.dumps(of_another))
    with pytest.raises(InvalidCameras, match="got none of 'frame 1'"):
        read_cameras(path)
