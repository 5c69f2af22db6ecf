"""Readers, the command line and uploads identify files with one function, and name the file to use instead."""

from __future__ import annotations

import io
import json
import os
import re
import zipfile
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from safetensors.numpy import save

from liftcore.errors import InvalidCameras, InvalidInput, InvalidSplats
from liftcore.evaluate.inspect import inspect_file
from liftcore.io.cameras import read_cameras
from liftcore.io.formats import SplatFormat
from liftcore.io.kinds import identify, wrong_kind
from liftcore.io.splats import read_splats, splat_files, write_splats
from liftcore.query.result import load_lift
from liftcore.text import open_encoder
from liftcore.values.lift_file import input_file
from liftcore.values.pack import read_features
from service import tasks
from service.errors import Misconfigured
from service.models import AssetKind
from service.process import Reporter
from service.settings import ServiceSettings, require_encoder_files
from tests.promises.bad_files import zipped
from tests.scenes import random_splats

SOG = Path(__file__).parents[2] / "data" / "splats" / "degree3.sog"
CLOUD = b"ply\nformat binary_little_endian 1.0\nelement vertex 0\n" + b"".join(
    b"property float %c\n" % axis for axis in b"xyz"
)
FOREIGN_FILES = {  # content, a word of its name and of what to do
    "page.html": (b"<!DOCTYPE html><title>SuperSplat Viewer</title>", "web page", "SuperSplat"),
    "failed.ply": (b"<!DOCTYPE html><h1>404</h1>", "web page", "download"),
    "model": (b"glTF\x02\0\0\0" + bytes(100), "glTF", "export"),
    "scene.ksplat": (bytes(5000), "ksplat", "splat-transform"),
    "mesh.ply": (CLOUD + b"element face 0\nproperty list uchar int a\nend_header\n", "mesh", "trained splats"),
    "cloud.ply": (CLOUD + b"end_header\n", "point cloud", "trained splats"),
    "a.mp4": (b"\0\0\0\x20ftypisom" + bytes(60), "video", "COLMAP"),
    "a.ply.gz": (b"\x1f\x8b\x08" + bytes(60), "archive", "unpack"),
    "cut.zip": (zipped({"a.png": bytes(60)})[:50], "damaged", "download it again"),
    "a.pkl": (b"\x80\x04\x95.", "pickle", "export"),
    "weights.safetensors": (save({"visual.conv1.weight": np.zeros(2, "f4")}), "safetensors", "pack"),
    "dataparser_transforms.json": (b'{"transform": [], "scale": 1.0}', "frame", "cameras"),
}


@pytest.mark.parametrize("name", FOREIGN_FILES)
def test_what_is_no_input_is_named_with_what_to_do(name: str, tmp_path: Path) -> None:
    content, word, hint = FOREIGN_FILES[name]
    path = tmp_path / name
    path.write_bytes(content)
    identity = identify(path)
    assert identity.kind is None and identity.recognised
    for expected_kind in ("splats", "cameras", "features", "lift", "table"):
        error = wrong_kind(path, expected_kind, InvalidInput)
        assert error is not None and re.search(word, error.got) and expected_kind in error.expected
    for reader, fault in ((read_splats, InvalidSplats), (read_cameras, InvalidCameras), (inspect_file, InvalidInput)):
        with pytest.raises(fault, match=f"(?s){word}.*({hint})"):
            reader(path)


def write_zip(path: Path, files: dict[str, bytes]) -> Path:
    path.write_bytes(zipped(files))
    return path


def splat_bytes(folder: Path) -> bytes:
    write_splats(folder / "some.ply", random_splats(0, 5))
    return (folder / "some.ply").read_bytes()


def test_a_zip_is_what_is_in_it_and_names_the_file_to_give(tmp_path: Path) -> None:
    splats = splat_bytes(tmp_path)
    single = write_zip(tmp_path / "one.zip", {"__MACOSX/._gs.ply": b"x", "3dgs/gs.ply": splats, "cloud.ply": CLOUD})
    with pytest.raises(InvalidSplats, match=r"a zip with 3dgs/gs\.ply in it; unzip it and give 3dgs/gs\.ply"):
        read_splats(single)
    with pytest.raises(InvalidCameras, match=r"a zip with 3dgs/gs\.ply in it"):
        read_cameras(single)
    several = write_zip(
        tmp_path / "two.zip", {"a.spz": b"", "iteration_7000/p.ply": splats, "iteration_30000/p.ply": splats}
    )
    assert identify(several).splats == ("iteration_30000/p.ply", "iteration_7000/p.ply", "a.spz")
    cases = {
        "photos": {"a.jpg": b"", "b.jpg": b""},
        "cameras": {"a.jpg": b"", "sparse/0/cameras.bin": b"", "sparse/0/images.bin": b"", "input.ply": CLOUD},
    }
    for kind, files in cases.items():
        assert identify(write_zip(tmp_path / f"{kind}.zip", files)).kind == kind
    words = {
        "features.npz": ({"a.npy": b""}, r"\.npz"),
        "pack.zip": ({"pack.safetensors": b""}, r"unzip it and give pack\.safetensors"),
    }
    for name, (files, word) in words.items():
        with pytest.raises(InvalidSplats, match=word):
            read_splats(write_zip(tmp_path / name, files))


@pytest.mark.parametrize(
    ("files", "last"),
    [
        (["point_cloud/iteration_7000/point_cloud.ply", "point_cloud/iteration_30000/point_cloud.ply", "input.ply"],
         "point_cloud/iteration_30000/point_cloud.ply"),
        (["ckpts/ckpt_6999_rank0.pt", "ckpts/ckpt_29999_rank0.pt", "ply/point_cloud_29999.ply"],
         "ply/point_cloud_29999.ply"),
        (["ckpts/ckpt_6999_rank0.pt", "ckpts/ckpt_29999_rank0.pt", "ckpts/ckpt_29999_rank0_features.pt"],
         "ckpts/ckpt_29999_rank0.pt"),
        (["a/splatfacto/2024/nerfstudio_models/step-000029999.ckpt", "a/splatfacto/2024/config.yml"],
         "a/splatfacto/2024/nerfstudio_models/step-000029999.ckpt"),
        (["export_5000.ply", "export_30000.ply"], "export_30000.ply"),
    ],
)  # fmt: skip
def test_a_trainers_folder_names_its_last_splats(files: list[str], last: str, tmp_path: Path) -> None:
    splats, folder = splat_bytes(tmp_path), tmp_path / "output"
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(CLOUD if name == "input.ply" else splats)
    with pytest.raises(InvalidSplats, match="got a folder") as error:
        read_splats(folder)
    assert str(folder / last) in error.value.hint
    (folder / "cameras.json").write_text("[]")  # which the original trainer puts there: its folder is cameras, too
    assert identify(folder).kind == "cameras"
    with pytest.raises(InvalidSplats) as error:
        read_splats(folder)
    assert str(folder / last) in error.value.hint


def test_folders_of_features_and_photos_name_the_command(tmp_path: Path) -> None:
    for folder, names, word in (
        ("language_features", ["a_f.npy", "a_s.npy"], "pack langsplat"),
        ("arrays", ["a.npy"], "pack npy"),
        ("images", ["a.jpg"], "COLMAP"),
    ):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / name).touch()
        with pytest.raises(InvalidCameras, match=word):
            read_cameras(tmp_path / folder)


def test_a_sog_is_its_folder_its_meta_json_and_a_zip_of_its_folder(tmp_path: Path) -> None:
    with zipfile.ZipFile(SOG) as archive:
        archive.extractall(tmp_path / "scene")
        folder_zip = write_zip(
            tmp_path / "z.zip", {f"scene/{name}": archive.read(name) for name in archive.namelist()}
        )
    expected, meta = read_splats(SOG), tmp_path / "scene" / "meta.json"
    for path in (tmp_path / "scene", meta, folder_zip):
        assert identify(path).format is SplatFormat.SOG
        assert (read_splats(path).means == expected.means).all()
    size = sum(file.stat().st_size for file in (tmp_path / "scene").iterdir())
    assert inspect_file(meta)["bytes"] == inspect_file(tmp_path / "scene")["bytes"] == size
    assert input_file(meta).sha256 == input_file(tmp_path / "scene").sha256
    (tmp_path / "scene" / "notes.txt").write_text("beside it")
    assert inspect_file(meta)["bytes"] == size and len(splat_files(meta)) == len(list(meta.parent.iterdir())) - 1
    with pytest.raises(InvalidCameras, match="got splats"):
        read_cameras(meta)
    (tmp_path / "scene" / "quats.webp").unlink()
    with pytest.raises(InvalidSplats, match=r"'quats\.webp' beside meta\.json, got none"):
        read_splats(meta)


def test_pipes_and_devices_are_refused_and_never_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    for path in (tmp_path / "pipe.ply", Path("/dev/zero")):
        for reader in (read_splats, read_cameras, inspect_file):
            with pytest.raises(InvalidInput, match="no regular file"):
                reader(path)
        with pytest.raises(OSError, match="no regular file"):
            input_file(path)


def test_a_file_in_the_place_of_another_kind_is_named_for_what_it_is_everywhere(tmp_path: Path) -> None:
    rows = np.ones((2, 3), np.float32)
    write_splats(tmp_path / "splats", random_splats(0, 5))
    contents = {
        "cameras": json.dumps({"frames": []}).encode(),
        "features": save({"v/grid": rows[None]}),
        "masks": save({"v/mask": np.zeros((2, 2), np.uint8)}),
        "table": save({"embeddings": rows}, metadata={"words": '["a", "b"]'}),
        "lift": save({"features": rows}, metadata={"splatlift": "{}"}),
        "photos": write_zip(tmp_path / "zip", {"a.png": b"\x89PNG\r\n"}).read_bytes(),
        "page": b"<!DOCTYPE html><title>404</title>",
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    readers = {
        "splats": read_splats, "cameras": read_cameras, "features": read_features, "lift": load_lift,
        "table": lambda path: open_encoder(f"table:{path}"),
    }  # fmt: skip
    settings = ServiceSettings.model_construct(encoder="", text_spaces={})
    for name in ("splats", *contents):
        path = tmp_path / name
        identity = identify(path)
        for expected_kind, reader in readers.items():
            if expected_kind != name:
                with pytest.raises(InvalidInput) as error:
                    reader(path)
                assert error.value.got == identity.name, (name, expected_kind)
        if name != "table":
            with pytest.raises(Misconfigured, match=re.escape(identity.name)):
                require_encoder_files(settings.model_copy(update={"encoder": f"table:{path}"}))
        for kind in (*get_args(AssetKind), "lift"):
            if kind != name:
                with pytest.raises(InvalidInput) as error:
                    tasks.check({"kind": kind, "file": str(path)}, Reporter(io.BytesIO()))
                assert identity.name in error.value.got, (name, kind)
                assert identity.kind is None or f"/{identity.kind}" in error.value.hint, (name, kind)
