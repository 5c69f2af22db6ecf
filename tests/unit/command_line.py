"""The command line in this process, and a scene that it lifts in no time."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore import cli
from liftcore.io.splats import write_splats
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.values.pack import write_pack
from liftcore.values.views import Regions
from tests.inria_file import write_inria_cameras

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

PROGRESS = re.compile(r"^\w+: \d+ of \d+ \w+\n", re.MULTILINE)  # what a slow machine tells every ten seconds


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """The exit status, and what went to stdout and stderr but for lines of progress."""
    status = cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return status, captured.out, PROGRESS.sub("", captured.err)


def assert_one_line(err: str) -> None:
    """Output on stderr is one line, and ends."""
    assert err.endswith("\n")
    assert err.count("\n") == 1


def write_toy_scene(folder: Path) -> Path:
    """Two splats before one camera, red at its left and green at its right, with a region for each."""
    splats = Splats(
        means=torch.tensor([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]]),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        log_scales=torch.full((2, 3), -1.5),
        opacity_logits=torch.full((2,), 4.0),
        sh=torch.zeros(2, 1, 3),
    )
    write_splats(folder / "splats.ply", splats)
    camera = Camera.pinhole("front", 32, 16, 16.0, 16.0, 16.0, 8.0, np.eye(4))
    write_inria_cameras(Cameras((camera,)), folder / "cameras.json")
    labels = torch.zeros(1, 16, 32, dtype=torch.int32)
    labels[..., 16:] = 1
    regions = Regions(labels, torch.eye(2, 3))
    metadata = {"encoder": "toy", "text_space": "none"}
    write_pack(folder / "pack.safetensors", {"front": regions, "lost": regions}, metadata)
    return folder


def lift_arguments(scene: Path, *more: object) -> list[object]:
    """The command that lifts it."""
    files = [scene / name for name in ("splats.ply", "cameras.json", "pack.safetensors")]
    return ["lift", *files, "-o", scene / "lift.safetensors", *more]
