"""What ``make gpu`` measures and writes, on the processor in place of a card: every part but the card itself."""

from __future__ import annotations

import os
import subprocess
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch

from liftcore.device import CPU, Device
from liftcore.evaluate.synthetic import room_cameras, room_regions, room_splats
from liftcore.io.lift_file import LiftResult
from liftcore.raster.base import CompositingParams
from liftcore.raster.reference import dense_view
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats
from liftcore.settings import LiftSettings
from tests.backends import needs_triton
from tests.benchmarks.gpu import __main__ as gpu
from tests.benchmarks.gpu import figures, gsplat_lift
from tests.benchmarks.gpu.figures import both_ways
from tests.benchmarks.gpu.gsplat_lift import SideBySide, at_pixels, beside_gsplat, lift_ours, lift_theirs
from tests.benchmarks.gpu.page import page
from tests.benchmarks.gpu.room_files import RoomSize, write_room

TINY = RoomSize(300, 40, 30, 2, 8)
ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "benchmarks_gpu.md"


def a_card_is_here() -> bool:
    return torch.version.cuda is not None and torch.cuda.is_available()


def test_page_holds_every_part_with_what_was_measured(tmp_path: Path) -> None:
    found = gpu.measure(CPU, (TINY, TINY), tmp_path, "the command")
    text = page(found)
    assert CPU.name in text and "`the command`" in text
    for title in ("whole lift", "A view", "Beside the processor", "tabletop", "gsplat"):
        assert any(title in line for line in text.splitlines() if line.startswith("## "))
    assert text.count("`tikhonov`") >= 2 and "| save |" in text and "The scene is not here" in text
    assert "are the same to the bit" in text and "strips" not in text
    near = found.agreements["room"]
    assert near.splats > 0 and near.only_one_sees == 0
    assert (near.least_cosine, near.largest_difference) == (pytest.approx(1.0), 0.0)  # the processor beside itself


def test_lifts_that_differ_in_a_bit_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, numbers = figures.lift, count()

    def lift(*given: Any) -> LiftResult:
        lifted = made(*given)
        lifted.features.view(torch.int16)[0, 0] ^= next(numbers)
        return lifted

    monkeypatch.setattr(figures, "lift", lift)
    found = replace(
        gpu.measure(CPU, (TINY, TINY), tmp_path, "the command"),
        pieces=figures.Pieces(["columns"], 10 << 20, 2 << 20, 3 << 20),
    )
    assert found.whole["differing"] == ["features"]
    assert "**They differ in features.**" in page(
        found
    ) and "2 MiB where one piece is planned at 10 MiB: columns, the memory" in page(found)
    monkeypatch.setattr(gpu, "choose_device", lambda _: CPU)
    monkeypatch.setattr(gpu, "measure", lambda *_: found)
    monkeypatch.setattr("sys.argv", ["gpu", str(tmp_path / "page.md")])
    assert gpu.main() == 1


@needs_triton
def test_a_view_in_pieces_is_held_to_the_view() -> None:
    """The check of a card's run, in the interpreter where there is none."""
    small = RoomSize(40, 20, 34, 1, 4, levels=1)
    place = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    pieces = figures.view_in_pieces(small, Device("cuda", place))
    assert pieces.broken == [] and 0 < pieces.free <= pieces.whole
    assert replace(pieces, peak=pieces.free).broken == [] != replace(pieces, peak=pieces.free + 1).broken


def test_agreement_tells_lifts_that_differ(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = write_room(tmp_path, TINY)
    answers = iter([{}, {"preset": "centre"}])
    made = figures.lift

    def lift(splats: Path, cameras: Path, features: list[Path], settings: LiftSettings) -> LiftResult:
        return made(splats, cameras, features, LiftSettings.of(certificate_rays=0, **next(answers)))

    monkeypatch.setattr(figures, "lift", lift)
    near = both_ways(paths, CPU)
    assert near.least_cosine < 0.999 and near.largest_difference > 1e-3


def dense_rasterization(splats: Splats, cameras: list[Camera]) -> Any:
    """gsplat's signature over the dense definition of A."""
    turns = iter(cameras)

    def rasterization(*given: Any, packed: bool) -> tuple[torch.Tensor, None, None]:
        means, quats, scales, opacities, colors, pose, intrinsics, width, height = given
        camera = next(turns)
        assert (camera.width, camera.height, packed) == (width, height, False)
        assert torch.equal(means, splats.means) and torch.equal(quats, splats.quats)
        torch.testing.assert_close(scales.log(), splats.log_scales)
        torch.testing.assert_close(torch.logit(opacities), splats.opacity_logits, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(pose[0].double(), torch.tensor(camera.viewmat), rtol=1e-5, atol=1e-5)
        assert intrinsics[0, 0, 0] == pytest.approx(camera.fx) and intrinsics[0, 1, 2] == pytest.approx(camera.cy)
        A = torch.tensor(dense_view(splats, camera, CompositingParams()).A, dtype=torch.float32)
        return (A @ colors).reshape(1, height, width, -1), None, None

    return rasterization


def test_gradient_through_a_renderer_is_our_lift() -> None:
    splats, cameras = room_splats(TINY.splats), room_cameras(TINY.views, TINY.width, TINY.height)
    views = [(camera, at_pixels(room_regions(camera, k, 2, 5), camera)) for k, camera in enumerate(cameras)]
    ours, totals = lift_ours(splats, views, CPU)
    theirs, sums = lift_theirs(dense_rasterization(splats, cameras), splats, views, CPU.place)
    torch.testing.assert_close(sums, totals, rtol=1e-4, atol=1e-4)
    seen = totals > 1e-2
    assert seen.sum() > 50
    torch.testing.assert_close(theirs[seen], ours[seen], rtol=1e-3, atol=1e-3)


def test_peer_that_cannot_run_is_told_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsplat_lift, "missing", lambda: "the package gsplat is not installed")
    assert beside_gsplat(TINY, CPU) == "the package gsplat is not installed"
    monkeypatch.setattr(gsplat_lift, "missing", lambda: "")

    def broken(*_: Any, **__: Any) -> None:
        raise RuntimeError("no nvcc\nhere")

    class Package:
        rasterization = broken

    monkeypatch.setattr(gsplat_lift, "import_module", lambda name: Package)
    assert beside_gsplat(TINY, CPU) == "gsplat did not run: RuntimeError: no nvcc here"

    def ours(*_: Any) -> None:
        raise RuntimeError("a fault of ours")

    monkeypatch.setattr(gsplat_lift, "lift_ours", ours)
    with pytest.raises(RuntimeError, match="a fault of ours"):
        beside_gsplat(TINY, CPU)


def test_peer_that_runs_is_timed_and_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    splats, cameras = room_splats(TINY.splats), room_cameras(TINY.views, TINY.width, TINY.height)

    class Package:
        rasterization = staticmethod(dense_rasterization(splats, cameras * (1 + gsplat_lift.ROUNDS)))

    monkeypatch.setattr(gsplat_lift, "missing", lambda: "")
    monkeypatch.setattr(gsplat_lift, "import_module", lambda name: Package)
    found = beside_gsplat(TINY, CPU)
    assert isinstance(found, SideBySide)
    assert found.cosine > 0.999 and found.ours_s > 0 and found.theirs_s > 0


def test_make_gpu_without_a_card_says_so_and_makes_nothing() -> None:
    if a_card_is_here():
        pytest.skip("there is a card here: make gpu would measure it")
    page_was_here = PAGE.exists()
    own = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    done = subprocess.run(["make", "gpu"], cwd=ROOT, env=own, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.splitlines()[0] == "make gpu: nvidia-smi lists no card here, so nothing was run"
    assert PAGE.exists() == page_was_here
