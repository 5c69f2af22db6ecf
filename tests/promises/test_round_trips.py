"""What is written comes back, row by row; and files of other programs are read as those programs read them.

``tests/data/splats`` holds scenes that splat-transform wrote, each beside the PLY that it makes of them.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import liftcore as lc
import numpy as np
import pytest
import torch
from liftcore import files
from scipy.spatial.transform import Rotation

from tests import tiny_scene
from tests.camera_files import binary_files, text_files, write_files
from tests.promises.scenes import KERNELS, random_scene, random_splats

SPLATS = Path(__file__).parents[1] / "data" / "splats"
FOREIGN = sorted(path for path in SPLATS.iterdir() if not path.name.endswith(".decoded.ply"))
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "beta", "sh")
BYTE, BASE = 0.5 / 255, 0.28209479177387814  # half a step of a byte; the harmonic of degree 0
QUANTA = {  # largest difference of what a format rounds; scales in logarithms, turns as entries of rotations
    ".glb": {"means": 1e-6, "scales": 1e-6, "opacities": 1e-6, "turns": 1e-6, "base": 1e-6, "sh": 1e-6},
    ".spz": {"means": 1e-5, "scales": 1 / 32, "opacities": BYTE, "turns": 4e-3, "base": BYTE / 0.15, "sh": 1 / 16},
    ".splat": {"means": 0, "scales": 1e-6, "opacities": BYTE, "turns": 0.02, "base": BYTE / BASE, "sh": math.inf},
}


def rendered_colours(splats: lc.Splats) -> dict[str, np.ndarray]:
    """Return what a viewer draws of 3D Gaussians: opacities, and quaternions as rotation matrices."""
    assert splats.sh is not None
    sh, quats = splats.sh.numpy(), splats.quats.double().numpy()
    return {
        "means": splats.means.numpy(),
        "scales": splats.log_scales.numpy(),
        "opacities": splats.opacity_logits.double().sigmoid().numpy(),
        "turns": Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix(),
        "base": sh[:, 0],
        "sh": sh[:, 1:],
    }


def labels(count: int) -> dict[str, np.ndarray]:
    ids = np.arange(count, dtype=np.int32) % 3
    return {"instance_id": ids, "class_id": ids // 2, "score": np.linspace(-1, 1, count, dtype=np.float32)}


@pytest.mark.parametrize("suffix", QUANTA)
def test_splats_come_back_within_the_quantum_of_the_format(suffix: str, tmp_path: Path) -> None:
    splats = random_splats(1, 200, degree=3)
    assert splats.sh is not None
    splats = replace(splats, sh=splats.sh.clamp(-0.9, 0.9), opacity_logits=splats.opacity_logits.clamp(-4, 4))
    path = tmp_path / f"s{suffix}"
    lc.write_splats(path, splats)
    actual, expected = rendered_colours(lc.read_splats(path)), rendered_colours(splats)
    for name, quantum in QUANTA[suffix].items():
        if quantum < math.inf:
            np.testing.assert_allclose(actual[name], expected[name], rtol=0, atol=quantum + 1e-6, err_msg=name)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_ply_keeps_every_number_kernel_and_column(kernel: str, degree: int, tmp_path: Path) -> None:
    splats, columns = random_splats(2, 50, kernel, degree if kernel != "dbs" else 0), labels(50)
    columns["part"] = np.arange(50, dtype=np.uint8)
    lc.write_splats(tmp_path / "s.ply", splats, columns)
    copy = lc.read_splats(tmp_path / "s.ply")
    assert copy.kernel == kernel
    for name in FIELDS:
        a, b = getattr(copy, name), getattr(splats, name)
        assert (a is None) == (b is None) and (a is None or torch.equal(a, b)), name
    for name, values in columns.items():
        np.testing.assert_array_equal(copy.extras[name].numpy(), values)
    lc.write_splats(tmp_path / "again.ply", copy)
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "s.ply").read_bytes()


SHAPE = [*(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
COLOUR = ["f_dc_0", "f_dc_1", "f_dc_2"]
DIALECTS = {  # order of columns, as trainers write them
    "inria": [*"xyz", "nx", "ny", "nz", *COLOUR, *(f"f_rest_{k}" for k in range(45)), "opacity", *SHAPE],
    "gsplat": [*"xyz", *COLOUR, "opacity", *SHAPE],
    "saga": [*"xyz", "mask", "nx", "ny", "nz", *COLOUR, "opacity", *SHAPE],
    "2dgs": [*"xyz", "nx", "ny", "nz", *COLOUR, "opacity", "scale_0", "scale_1", *SHAPE[3:]],
    "no colour": [*"xyz", "opacity", *SHAPE],
}


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("line_end", [b"\n", b"\r\n"])
def test_ply_of_every_dialect_is_written_back_to_the_byte(dialect: str, line_end: bytes, tmp_path: Path) -> None:
    names = DIALECTS[dialect]
    rows = np.random.default_rng(0).normal(size=(7, len(names))).astype(np.float32)
    head, end, body = tiny_scene.ply(rows, names).partition(b"end_header\n")
    head = head.replace(b"element", "comment café 点\nelement".encode())
    path = tmp_path / "s.ply"
    path.write_bytes((head + end).replace(b"\n", line_end) + body)
    splats = lc.read_splats(path)
    assert splats.kernel == ("2dgs" if dialect == "2dgs" else "3dgs")
    for name, column in {
        "x": splats.means[:, 0],
        "opacity": splats.opacity_logits,
        "rot_3": splats.quats[:, 3],
    }.items():
        np.testing.assert_array_equal(column.numpy(), rows[:, names.index(name)])
    if dialect == "inria":  # whose harmonics are stored a channel after the other
        assert splats.sh is not None
        np.testing.assert_array_equal(splats.sh[:, 1:].numpy(), rows[:, 9:54].reshape(7, 3, 15).transpose(0, 2, 1))
    lc.write_splats(tmp_path / "again.ply", splats)
    assert (tmp_path / "again.ply").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("path", FOREIGN, ids=lambda path: path.name)
def test_files_of_splat_transform_are_read_as_it_reads_them(path: Path, tmp_path: Path) -> None:
    source = "degree3.sog" if path.suffix == ".glb" else path.name
    expected = lc.read_splats(SPLATS / f"{source}.decoded.ply")
    unnamed = tmp_path / "upload"
    unnamed.write_bytes(path.read_bytes())
    if path.suffix == ".sog":
        with zipfile.ZipFile(path) as archive:
            archive.extractall(tmp_path / "folder")
        assert torch.equal(lc.read_splats(tmp_path / "folder").means, lc.read_splats(path).means)
    for file in (path, unnamed):
        actual, drawing = rendered_colours(lc.read_splats(file)), rendered_colours(expected)
        for name, values in drawing.items():
            tolerance = 0.02 if name == "turns" and path.suffix == ".splat" else 3e-5 * np.abs(values).max(initial=1)
            np.testing.assert_allclose(actual[name], values, rtol=0, atol=tolerance, err_msg=name)


@pytest.mark.parametrize("trainer", ["gsplat", "nerfstudio", "nerfstudio of old"])
def test_checkpoints_are_read_as_the_tensors_in_them(trainer: str, tmp_path: Path) -> None:
    splats, path = random_splats(4, 30, degree=3), tmp_path / "step-000029999.ckpt"
    assert splats.sh is not None
    tensors: dict[str, Any] = {"means": splats.means, "quats": splats.quats, "scales": splats.log_scales}
    if trainer == "gsplat":
        tensors |= {"opacities": splats.opacity_logits, "sh0": splats.sh[:, :1], "shN": splats.sh[:, 1:]}
        content: dict[str, Any] = {"step": 1, "splats": {k: torch.nn.Parameter(v) for k, v in tensors.items()}}
    else:
        tensors |= {"opacities": splats.opacity_logits[:, None], "features_dc": splats.sh[:, 0]}
        tensors |= {"features_rest": splats.sh[:, 1:]}
        before = "_model." if trainer.endswith("old") else "_model.gauss_params."
        rates = {"means": {"last_epoch": np.int64(7)}}
        content = {"pipeline": {f"{before}{k}": v for k, v in tensors.items()}, "schedulers": rates}
    torch.save(content, path)
    copy = lc.read_splats(path)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        assert torch.equal(getattr(copy, name), getattr(splats, name)), name


def test_lift_comes_back_with_every_array_and_its_settings(tmp_path: Path) -> None:
    result = lc.lift(*random_scene().arguments(), progress=False).as_codes()
    result.save(tmp_path / "lift.safetensors")
    copy = lc.load_lift(tmp_path / "lift.safetensors")
    arrays, copies = result.arrays(), copy.arrays()
    assert list(arrays) == list(copies)
    for name, values in arrays.items():
        assert values.dtype == copies[name].dtype
        np.testing.assert_array_equal(values, copies[name])
    assert (copy.settings, copy.views, copy.diagnostics) == (result.settings, result.views, result.diagnostics)


def test_region_weights_come_back(tmp_path: Path) -> None:
    scene = random_scene()
    weights = lc.region_weights(*scene.arguments(), progress=False)
    weights.save(tmp_path / "w")
    copy = lc.RegionWeights.load(tmp_path / "w")
    assert copy.views == weights.views
    np.testing.assert_array_equal(copy.matrix(300).toarray(), weights.matrix(300).toarray())


POSES = {  # name of the photo -> quaternion w x y z and translation, from the world to the camera
    "frame 1.jpg": ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0)),
    "left/000.png": ((0.5, 0.5, 0.5, 0.5), (1.0, 2.0, 3.0)),
    "right/000.png": ((0.5, 0.5, 0.5, 0.5), (1.1, 2.0, 3.0)),  # of a rig: all views keep their folders
    "left/c.0003.JPG": ((0.0, 0.0, 2.0, 0.0), (0.5, -0.5, 1.0)),  # no unit quaternion
}
SIZE, INTRINSICS = (640, 480), (500.0, 510.0, 320.0, 240.0)  # fx, fy and the principal point
PINHOLE = (1, "PINHOLE", INTRINSICS)  # COLMAP's number, name and parameters


def viewmats() -> dict[str, np.ndarray]:
    matrices = {}
    for name, (quaternion, translation) in POSES.items():
        matrices[name] = np.eye(4)
        matrices[name][:3, :3] = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
        matrices[name][:3, 3] = translation
    return matrices


def colmap(write: Callable[..., dict[str, bytes]], camera: tuple[Any, ...] = PINHOLE) -> dict[str, bytes]:
    """Return the files of a model whose images have one camera."""
    return write({1: camera}, [(1, *pose, name) for name, pose in POSES.items()])


def transforms() -> dict[str, bytes]:
    flip = np.diag([1.0, -1, -1, 1])  # axes of OpenGL
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (np.linalg.inv(matrix) @ flip).tolist()}
        for name, matrix in viewmats().items()
    ]
    fx, fy, cx, cy = INTRINSICS
    shared = {"w": SIZE[0], "h": SIZE[1], "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    return {"transforms.json": json.dumps(shared | {"frames": frames}).encode()}


def inria() -> dict[str, bytes]:
    records = []
    for number, (name, matrix) in enumerate(viewmats().items()):
        pose = np.linalg.inv(matrix)
        record = {"id": number, "img_name": name.rpartition(".")[0], "width": SIZE[0], "height": SIZE[1]}
        record |= {"fx": INTRINSICS[0], "fy": INTRINSICS[1]}
        records.append(record | {"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()})
    return {"cameras.json": json.dumps(records).encode()}


CAMERA_FILES = {
    "text": lambda: colmap(text_files), "binary": lambda: colmap(binary_files),
    "transforms": transforms, "inria": inria,
}  # fmt: skip


def assert_cameras(cameras: lc.Cameras) -> None:
    assert {name.removeprefix("images/") for name in cameras} == {"frame 1", "left/000", "right/000", "left/c.0003"}
    for name, matrix in viewmats().items():
        camera = cameras[name.rpartition(".")[0]]
        np.testing.assert_allclose(camera.viewmat, matrix, atol=1e-9)
        assert (camera.width, camera.height) == SIZE
        np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], INTRINSICS)


@pytest.mark.parametrize("kind", CAMERA_FILES)
def test_cameras_of_every_format_are_the_same(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / ("sparse/0" if kind in ("text", "binary") else "")
    write_files(folder, CAMERA_FILES[kind]())
    assert_cameras(lc.read_cameras(tmp_path))


@pytest.mark.parametrize("root", ["", "scene/sparse/0/", "sparse\\0\\"])
@pytest.mark.parametrize("kind", ["text", "binary"])
def test_zipped_model_is_read_at_any_depth(kind: str, root: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "upload", "w") as archive:
        for name, content in CAMERA_FILES[kind]().items():
            member = zipfile.ZipInfo("x")
            member.filename = root + name  # with backslashes as PowerShell 5 writes them
            archive.writestr(member, content)
    assert_cameras(lc.read_cameras(tmp_path / "upload"))
    assert [path.name for path in tmp_path.iterdir()] == ["upload"]


LENSES = {  # COLMAP's number, and parameters behind fx fy cx cy
    "OPENCV": (4, (0.05, -0.02, 0.001, 0.002)),
    "OPENCV_FISHEYE": (5, (0.02, 0.01, 0.0, 0.0)),
}


@pytest.mark.parametrize("model", LENSES)
def test_text_and_binary_models_say_the_same_lens(model: str, tmp_path: Path) -> None:
    number, parameters = LENSES[model]
    read = []
    for write in (text_files, binary_files):
        folder = tmp_path / write.__name__
        write_files(folder, colmap(write, (number, model, (*INTRINSICS, *parameters))))
        read.append(lc.read_cameras(folder))
    for camera, twin in zip(read[0].values(), read[1].values(), strict=True):
        assert camera.lens is not None and camera.lens == twin.lens
        np.testing.assert_array_equal(camera.viewmat, twin.viewmat)


PAIRS = [  # names of views and of cameras, and which pair
    (["000"], ["camA/000"], {"000": "camA/000"}),
    (["camA/000"], ["000"], {"camA/000": "000"}),
    (["/photos/camA/000"], ["camA/000", "camB/000"], {"/photos/camA/000": "camA/000"}),
    (["000"], ["train/000", "test/000"], {}),
    (["train/000", "test/000"], ["000"], {}),
    (["train/000", "test/000"], ["train/000"], {"train/000": "train/000"}),
    (["train/000"], ["test/000"], {}),
    (["0", "camA/0"], ["0"], {"0": "0"}),  # the same name comes first
    (["A/0"], ["camA/0"], {}),  # whole folders only
    (["K\u00fcche_0", "K\u00fcche_1"], ["Ku\u0308che_1"], {"K\u00fcche_1": "Ku\u0308che_1"}),  # of a Mac
]


@pytest.mark.parametrize(("views", "cameras", "pairs"), PAIRS)
def test_views_pair_with_the_one_camera_that_ends_like_them(
    views: list[str], cameras: list[str], pairs: dict[str, str]
) -> None:
    assert files.cameras_of_views(views, cameras) == pairs
