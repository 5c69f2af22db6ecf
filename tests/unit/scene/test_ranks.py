"""One rank of a training on several GPUs is a part of a scene, and is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from liftcore.errors import InvalidSplats
from liftcore.io.splats import read_splats
from liftcore.scene.splats import Splats
from tests.scenes import random_splats


def write_rank(path: Path, splats: Splats, rows: slice) -> None:
    tensors = {"means": splats.means[rows], "quats": splats.quats[rows], "scales": splats.log_scales[rows]}
    tensors |= {"opacities": splats.opacity_logits[rows]}
    torch.save({"step": 29_999, "splats": {name: value.clone() for name, value in tensors.items()}}, path)


def write_ranks(folder: Path, splats: Splats, step: int = 29_999) -> Path:
    folder.mkdir(exist_ok=True)
    for rank, rows in enumerate((slice(0, 13), slice(13, 20), slice(20, splats.count))):
        write_rank(folder / f"ckpt_{step}_rank{rank}.pt", splats, rows)
    return folder


def test_half_a_scene_of_ranks_is_refused(tmp_path: Path) -> None:
    folder = write_ranks(tmp_path / "ckpts", random_splats(3, 50))
    for rank in range(3):
        with pytest.raises(InvalidSplats, match=r"one of several GPUs.*join the tensors"):
            read_splats(folder / f"ckpt_29999_rank{rank}.pt")
    (folder / "ckpt_29999_rank0.pt").rename(tmp_path / "ckpt_29999_rank0.pt")
    (folder / "ckpt_29999_rank1.pt").rename(tmp_path / "alone_rank1.pt")
    assert read_splats(tmp_path / "ckpt_29999_rank0.pt").count == 13  # nothing says that it is a part
    with pytest.raises(InvalidSplats, match="one of several GPUs"):
        read_splats(tmp_path / "alone_rank1.pt")


def test_the_only_rank_of_a_run_is_no_part_of_anything(tmp_path: Path) -> None:
    write_rank(tmp_path / "ckpt_29999_rank0.pt", random_splats(3, 50), slice(0, 50))
    write_rank(tmp_path / "ckpt_6999_rank0.pt", random_splats(3, 50), slice(0, 50))
    assert read_splats(tmp_path / "ckpt_29999_rank0.pt").warnings == ()
