"""Checkpoints of several ranks: a single one gives a warning, and their folder is the complete scene."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from liftcore.errors import InvalidSplats
from liftcore.evaluate.inspect import inspect_file
from liftcore.io.splats import read_places, read_splats
from liftcore.query.scene import Scene
from liftcore.scene.splats import Splats
from liftcore.values.lift_file import input_file
from tests.scenes import random_splats, write_scene
from tests.unit.command_line import run


def write_rank(path: Path, splats: Splats, rows: slice) -> None:
    tensors = {"means": splats.means[rows], "quats": splats.quats[rows], "scales": splats.log_scales[rows]}
    tensors |= {"opacities": splats.opacity_logits[rows]}
    torch.save({"step": 29_999, "splats": {name: value.clone() for name, value in tensors.items()}}, path)


def write_ranks(folder: Path, splats: Splats, step: int = 29_999) -> Path:
    folder.mkdir(exist_ok=True)
    for rank, rows in enumerate((slice(0, 13), slice(13, 20), slice(20, splats.count))):
        write_rank(folder / f"ckpt_{step}_rank{rank}.pt", splats, rows)
    return folder


def test_a_folder_of_ranks_is_the_whole_scene_in_their_order(tmp_path: Path) -> None:
    splats = random_splats(3, 50)
    folder = write_ranks(tmp_path / "ckpts", splats)
    write_ranks(folder, random_splats(4, 50), step=6_999)  # an earlier step
    actual = read_splats(folder)
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        assert torch.equal(getattr(actual, name), getattr(splats, name))
    assert actual.warnings == ()
    assert torch.equal(torch.from_numpy(read_places(folder)), splats.means)
    assert inspect_file(folder)["bytes"] == sum(file.stat().st_size for file in folder.glob("ckpt_29999*"))
    before = input_file(folder).sha256
    (folder / "ckpt_6999_rank2.pt").unlink()
    assert input_file(folder).sha256 == before
    write_rank(folder / "ckpt_29999_rank1.pt", random_splats(5, 50), slice(0, 7))
    assert input_file(folder).sha256 != before


def test_ranks_that_lack_one_or_do_not_fit_are_said(tmp_path: Path) -> None:
    folder = write_ranks(tmp_path / "ckpts", random_splats(3, 50))
    (folder / "ckpt_29999_rank1.pt").unlink()
    assert "rank 1 is missing" in read_splats(folder).warnings[0]
    torch.save({"splats": {"means": torch.zeros(2, 4)}}, folder / "ckpt_29999_rank1.pt")
    with pytest.raises(InvalidSplats):
        read_splats(folder)


def test_every_command_says_that_one_rank_is_a_part_and_takes_the_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    splats, cameras, packs = write_scene(tmp_path, 7)
    folder, out = write_ranks(tmp_path / "ckpts", read_splats(splats)), tmp_path / "l.safetensors"
    first, words = folder / "ckpt_29999_rank0.pt", "ckpt_29999_rank1.pt, ckpt_29999_rank2.pt beside ckpt_29999_rank0"
    lift = ("-o", out, "--set", "preset=row-sum")
    for command, arguments in (
        ("inspect", ()),
        ("plan", (cameras, packs)),
        ("check", (cameras,)),
        ("lift", (cameras, packs)),
    ):
        status, text, err = run(capsys, command, first, *arguments, *(lift if command == "lift" else ()))
        assert status == (2 if command == "check" else 0), (command, text, err)  # a part fills few rays
        assert words in text
        status, text, err = run(capsys, command, folder, *arguments, *(lift if command == "lift" else ()))
        assert status == 0 and "beside" not in text, (command, text, err)
    scene = Scene(out)
    assert scene.splats.count == 50 and scene.axes.shape == (3, 50)


def test_a_trainers_folder_names_the_folder_of_its_ranks(tmp_path: Path) -> None:
    folder = write_ranks(tmp_path / "ckpts", random_splats(3, 50))
    with pytest.raises(InvalidSplats, match=rf"give {re.escape(str(folder))}$"):
        read_splats(tmp_path)


def test_the_only_rank_of_a_run_is_no_part_of_anything(tmp_path: Path) -> None:
    write_rank(tmp_path / "ckpt_29999_rank0.pt", random_splats(3, 50), slice(0, 50))
    write_rank(tmp_path / "ckpt_6999_rank0.pt", random_splats(3, 50), slice(0, 50))
    assert read_splats(tmp_path / "ckpt_29999_rank0.pt").warnings == ()
