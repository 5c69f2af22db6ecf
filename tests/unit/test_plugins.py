"""Formats and encoders of other packages, found by their entry points."""

from pathlib import Path

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.features.encoders import open_image_encoder
from liftcore.io.splats import read_places
from tests.scenes import random_splats

MODULE = """
import numpy as np
import liftcore as lc

class Words:
    name, channels = "mine", 4
    def __init__(self, rest): self.rest = rest
    def encode(self, texts): return np.eye(4, dtype=np.float32)[[len(text) % 4 for text in texts]]

class Photos:
    name, text_space, pixels, channels = "photos", "mine", None, 4
    def __init__(self, rest, device): self.rest, self.device = rest, device
    def encode(self, images): return images

def read(path):
    means = np.loadtxt(path, ndmin=2)
    zeros = np.zeros((len(means), 3), np.float32)
    return lc.Splats(means.astype(np.float32), np.ones((len(means), 4), np.float32), zeros, zeros[:, 0])

def broken(*given): return 1 / 0
def other(*given): return 7
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Install a package with entry points: group -> name -> object of the module."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "theirs.py").write_text(MODULE)

    def add(package: str, **groups: dict[str, str]) -> None:
        folder = tmp_path / f"{package}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        lines = []
        for group, entries in groups.items():
            lines += [f"[splatlift.{group}]", *(f"{name} = theirs:{target}" for name, target in entries.items())]
        (folder / "entry_points.txt").write_text("\n".join(lines) + "\n")

    return add


def test_plugins_are_opened_by_their_names(install, tmp_path: Path) -> None:
    install("ours", text_encoders={"mine": "Words"}, image_encoders={"mine": "Photos"}, splat_formats={"xyz": "read"})
    encoder = lc.open_encoder("mine:large")
    assert encoder.encode(["a", "bb"]).argmax(axis=1).tolist() == [1, 2] and encoder.rest == "large"  # pyright: ignore
    assert lc.open_encoder("mine").name == "mine" and open_image_encoder("mine:x").name == "photos"
    (tmp_path / "scene.xyz").write_text("0 0 1\n2 3 4\n")
    splats = lc.read_splats(tmp_path / "scene.xyz")
    assert splats.means.tolist() == [[0, 0, 1], [2, 3, 4]]
    np.testing.assert_array_equal(read_places(tmp_path / "scene.xyz"), splats.positions())


def test_content_comes_before_a_plugin_and_unknown_names_list_the_plugins(install, tmp_path: Path) -> None:
    install("ours", text_encoders={"mine": "Words"}, splat_formats={"xyz": "broken"})
    lc.write_splats(tmp_path / "scene.ply", random_splats(1))
    (tmp_path / "scene.ply").rename(tmp_path / "scene.xyz")
    assert torch.equal(lc.read_splats(tmp_path / "scene.xyz").means, random_splats(1).means)
    with pytest.raises(lc.InvalidQuery, match=r"encoder: expected one of .*mine:\.\.\., got 'yours'"):
        lc.open_encoder("yours")
    with pytest.raises(lc.InvalidSplats, match="no such file"):
        lc.read_splats("nowhere.xyz")


def test_broken_plugins_are_named_with_their_package(install, tmp_path: Path) -> None:
    formats = {"bad": "broken", "odd": "other", "gone": "nothing"}
    install("ours", text_encoders=formats, image_encoders=formats, splat_formats=formats)
    for name, message in (
        ("bad", "plugin 'bad' of the package ours: expected a working plugin, got ZeroDivisionError"),
        ("odd", "plugin 'odd' of the package ours: expected a value with .*, got int without"),
        ("gone", "plugin 'gone' of the package ours: .* AttributeError.*theirs:nothing imports and runs"),
    ):
        (tmp_path / f"scene.{name}").write_text("0 0 1\n")
        for open_plugin in (lc.open_encoder, open_image_encoder):
            with pytest.raises(lc.Unavailable, match=message):
                open_plugin(name)
        with pytest.raises(lc.Unavailable, match=message):
            lc.read_splats(tmp_path / f"scene.{name}")


def test_two_packages_of_one_name_are_refused_and_built_in_names_stay(install, caplog) -> None:
    install("ours", text_encoders={"mine": "Words", "lvis": "other"})
    install("theirs", text_encoders={"mine": "Words"})
    with pytest.raises(
        lc.Unavailable, match=r"plugin 'mine': .*'mine' of the package ours and 'mine' of the package"
    ):
        lc.open_encoder("mine")
    assert "'lvis' of the package ours is ignored" in caplog.text
    assert lc.open_encoder("lvis").channels == 512


def test_a_command_of_the_service_stays_its_own(install) -> None:
    install("theirs", commands={"serve": "other", "mine": "other"})
    assert lc.load_plugin("splatlift.commands", "serve").__name__ == "service.commands.serve"
    assert lc.load_plugin("splatlift.commands", "mine")() == 7
