"""Remote inputs and outputs, on fsspec's memory and local file systems."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fsspec
import pytest
import torch

import liftcore as lc
from liftcore.cli import main
from liftcore.io.inria import write_inria_cameras
from liftcore.io.remote import local_path
from liftcore.io.shards import INDEX
from liftcore.io.splats import write_splats
from liftcore.values.pack import write_pack
from tests.scenes import centred, observed, random_camera, random_splats

FILES = ("splats.ply", "cameras.json", "features.safetensors")


@pytest.fixture(params=["memory", "file"])
def remote_folder(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the URL of a folder that holds the files of a scene."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    views = tuple(centred(random_camera(k, 32, 24, name=f"v{k}")) for k in range(3))
    write_splats(tmp_path / FILES[0], random_splats(1, 50))
    write_inria_cameras(lc.Cameras(views), tmp_path / FILES[1])
    write_pack(tmp_path / FILES[2], {camera.name: observed(1, k, False) for k, camera in enumerate(views)}, {})
    base = f"memory://{uuid.uuid4()}" if request.param == "memory" else f"file://{tmp_path}/elsewhere"
    storage = fsspec.filesystem(request.param)
    storage.makedirs(base, exist_ok=True)
    for name in FILES:
        storage.put_file(str(tmp_path / name), f"{base}/{name}")
    return base


def read(base: str) -> tuple[Any, ...]:
    return (
        lc.read_splats(f"{base}/{FILES[0]}"),
        lc.read_cameras(f"{base}/{FILES[1]}"),
        lc.read_features(f"{base}/{FILES[2]}"),
    )


@pytest.mark.parametrize("name", ["one.safetensors", "many.shards"])
def test_lift_of_inputs_elsewhere_is_saved_there_and_opened(remote_folder: str, name: str, tmp_path: Path) -> None:
    lift = lc.lift(*read(remote_folder), diagnostic_rays=0)
    local = lc.lift(*read(str(tmp_path)), diagnostic_rays=0)
    assert torch.equal(lift.features, local.features)
    for _ in range(2):  # over another of the same name, too
        lift.save(f"{remote_folder}/out/{name}")
    copy = lc.load_lift(f"{remote_folder}/out/{name}")
    assert torch.equal(copy.features, lift.features) and torch.equal(copy.total_weight, lift.total_weight)
    storage, place = fsspec.url_to_fs(f"{remote_folder}/out")
    files = {path.removeprefix(place).lstrip("/") for path in storage.find(place)}
    assert files == {name} if name.endswith("safetensors") else f"{name}/{INDEX}" in files


def test_folder_of_cameras_comes_whole_and_what_changed_comes_anew(remote_folder: str, tmp_path: Path) -> None:
    storage, place = fsspec.url_to_fs(f"{remote_folder}/model")
    storage.makedirs(place, exist_ok=True)
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 32 24 30 30 16 12\n")
    storage.put_file(str(tmp_path / "cameras.txt"), f"{place}/cameras.txt")
    for count in (1, 2):
        lines = [f"{number} 1 0 0 0 0 0 {number} 1 v{number}.png\n\n" for number in range(1, count + 1)]
        (tmp_path / "images.txt").write_text("".join(lines))
        storage.put_file(str(tmp_path / "images.txt"), f"{place}/images.txt")
        assert len(lc.read_cameras(f"{remote_folder}/model")) == count


class Tagged(fsspec.AbstractFileSystem):
    """A file system like HTTP: sizes and entity tags, and no lists of folders."""

    protocol = "tagged"
    content = b"one"

    def ls(self, path: str, detail: bool = True, **_: Any) -> list[Any]:
        raise FileNotFoundError(path)

    def isfile(self, path: str) -> bool:
        return True

    def info(self, path: str, **_: Any) -> dict[str, Any]:
        return {"name": path, "size": len(self.content), "ETag": self.content.decode()}

    def ukey(self, path: str) -> str:
        return path

    def get_file(self, rpath: Any, lpath: Any, *_: Any, **__: Any) -> None:
        Path(lpath).write_bytes(self.content)


def test_file_with_another_entity_tag_comes_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    fsspec.register_implementation("tagged", Tagged, clobber=True)
    first = local_path("tagged://host/file")
    assert local_path("tagged://host/file") == first and first.read_bytes() == b"one"
    monkeypatch.setattr(Tagged, "content", b"two")
    assert local_path("tagged://host/file").read_bytes() == b"two"


@pytest.mark.parametrize("reader", [lc.read_splats, lc.read_cameras, lc.read_features, lc.load_lift])
@pytest.mark.parametrize("url", ["memory://nowhere/at-all", "nothing-like-it://bucket/file"])
def test_error_of_a_missing_input_names_its_url(reader: Callable[[str], Any], url: str) -> None:
    with pytest.raises(lc.InvalidInput, match=url.partition(":")[0]) as error:
        reader(url)
    assert error.value.argument == url and "fsspec" in error.value.expected


def test_commands_take_inputs_and_write_lifts_elsewhere(
    remote_folder: str, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs, out = [f"{remote_folder}/{name}" for name in FILES], f"{remote_folder}/lift.safetensors"
    assert main(["lift", *inputs, "-o", out, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["out"] == out
    assert main(["inspect", out, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["kind"] == "lift"
    assert main(["inspect", f"{remote_folder}/nothing"]) == 2
    assert f"{remote_folder}/nothing" in capsys.readouterr().err


def test_storage_that_does_not_open_is_refused_before_the_lift(
    remote_folder: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("liftcore.lifting.files.lift_files", None)  # the work, which would be our fault
    status = main(
        ["lift", *(f"{remote_folder}/{name}" for name in FILES), "-o", "nothing-like-it://bucket/x.safetensors"]
    )
    assert status == 2 and "nothing-like-it" in capsys.readouterr().err
