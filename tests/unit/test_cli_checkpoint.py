"""`splatlift lift --checkpoint`: walked views are kept, and other features of the same regions use them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import torch

from liftcore.io.lift_file import load_lift
from liftcore.raster.cpu.raster import CpuRaster

from .command_line import assert_one_line, lift_arguments, run, write_toy_scene

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_toy_scene(tmp_path)


def test_a_second_lift_walks_no_view_and_gives_the_same_bits(
    scene: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = scene / "kept" / "here"
    arguments = lift_arguments(scene, "--checkpoint", kept, "--device", "cpu")
    assert run(capsys, *arguments)[0] == 0
    first = load_lift(scene / "lift.safetensors")
    features = first.features.clone()
    assert list(kept.glob("*.safetensors"))

    def never(self: CpuRaster, camera: Any, *rest: Any) -> Any:
        raise AssertionError(f"{camera.name} was walked again")

    monkeypatch.setattr(CpuRaster, "region_weights", never)
    monkeypatch.setattr("liftcore.lifting.warm_up_lift", lambda *_: None)  # which walks a scene of its own
    monkeypatch.setattr("liftcore.planning.plan.contradictions", lambda *_: [])  # which looks at some views, coarsely
    assert run(capsys, *arguments)[0] == 0
    assert torch.equal(load_lift(scene / "lift.safetensors").features, features)


def test_a_checkpoint_that_cannot_be_written_is_told_before_the_work(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = scene / "splats.ply"
    status, out, err = run(capsys, *lift_arguments(scene, "--checkpoint", taken, "--json"))
    assert (status, out) == (2, "")
    assert "checkpoint: expected a folder that can be written" in err
    assert_one_line(err)
    assert not (scene / "lift.safetensors").exists()
