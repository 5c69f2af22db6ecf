"""Peers lift the same X, are timed in turns and within a budget, and the page tells all of it."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from liftcore.raster.base import CompositingParams
from liftcore.raster.reference import dense_view, reading_matrix
from tests.benchmarks.peers import __main__ as command
from tests.benchmarks.peers import side_by_side, torch_autograd
from tests.benchmarks.peers.agreement import agreement
from tests.benchmarks.peers.dense_numba import DenseNumba
from tests.benchmarks.peers.everybody import PEERS, SIZES
from tests.benchmarks.peers.metal_gauss import MetalGauss
from tests.benchmarks.peers.ours import Ours
from tests.benchmarks.peers.side_by_side import Axis, Comparison, Limits, Sizes
from tests.benchmarks.peers.torch_autograd import TorchAutograd
from tests.benchmarks.peers.work import Answer, Size, Work, room
from tests.scenes import random_camera, random_regions, random_splats

if TYPE_CHECKING:
    from tests.benchmarks.peers.peer import Peer

EXACT = (Ours(), DenseNumba(), TorchAutograd())
WALKS = (CompositingParams(), CompositingParams(alpha_cap=0.9, transmittance_stop=0.05))
TINY = Size(splats=300, width=40, height=30, views=1, channels=3)


def small_work(walk: CompositingParams = WALKS[0]) -> Work:
    """Two views of 80 splats, some pixels without a label, no side a multiple of a tile."""
    views = tuple((random_camera(seed, name=f"v{seed}"), random_regions(seed, levels=3, F=5)) for seed in (1, 2))
    return Work(random_splats(3, 80), views, threads=2, walk=walk)


def oracle(work: Work) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """X [P, F] and totals [P] in float64, and the splats [P] that no ray at a cut-off meets."""
    sums = np.zeros((work.splats.count, work.channels))
    totals, clear = np.zeros(work.splats.count), np.ones(work.splats.count, bool)
    for camera, regions in work.views:
        view = dense_view(work.splats, camera, work.walk)
        S, ray = reading_matrix(regions, camera.width, camera.height)
        sums += view.A[ray].T @ (S @ regions.codebook.double().numpy())
        totals += view.A[ray].sum(axis=0)
        clear &= ~(view.A[view.cut] > 0).any(axis=0)
    return np.divide(sums, totals[:, None], out=np.zeros_like(sums), where=totals[:, None] > 0), totals, clear


@pytest.mark.parametrize("walk", WALKS, ids=["usual", "early stop"])
@pytest.mark.parametrize("peer", EXACT, ids=lambda peer: peer.name)
def test_a_peers_features_equal_the_oracles(peer: Peer, walk: CompositingParams) -> None:
    work = small_work(walk)
    features, totals, clear = oracle(work)
    answer = peer.lift(work)
    seen = clear & (totals > 1e-3)
    assert seen.sum() > 20
    np.testing.assert_allclose(answer.totals.numpy()[seen], totals[seen], rtol=2e-4)
    np.testing.assert_allclose(answer.features.numpy()[seen], features[seen], atol=2e-4)


def test_the_public_renderer_lifts_the_same_where_it_is_installed() -> None:
    peer = MetalGauss()
    if peer.missing():
        pytest.skip(peer.missing())
    work = room(TINY, threads=2)
    assert agreement(Ours().lift(work), peer.lift(work)).same


def test_slabs_and_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    work = small_work(WALKS[1])
    whole = TorchAutograd().lift(work)
    for name, value in (("SLAB", 3), ("WEIGHTS", 1), ("CHANNELS", 2)):
        monkeypatch.setattr(torch_autograd, name, value)
    cut = TorchAutograd().lift(work)
    torch.testing.assert_close(cut.totals, whole.totals, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(cut.features, whole.features, rtol=1e-4, atol=1e-5)


def test_a_peer_that_computes_another_thing_is_told_apart() -> None:
    ours = Ours().lift(small_work())
    turned = Answer(ours.features.roll(1, dims=1), ours.totals)
    assert agreement(ours, ours).same
    assert not agreement(ours, turned).same
    assert agreement(ours, turned).error > 0.1


@dataclass
class Clock:
    """Time that passes only when a peer says so."""

    now: float = 0.0

    def __call__(self) -> float:
        return self.now


class Slow:
    """A peer whose lift takes so many seconds a ray of the work."""

    computes = "our own X, slowly"

    def __init__(self, name: str, clock: Clock, seconds: float) -> None:
        self.name, self.clock, self.seconds, self.lifted = name, clock, seconds, []

    def missing(self) -> str:
        return ""

    def lift(self, work: Work) -> Answer:
        camera = work.views[0][0]
        self.clock.now += self.seconds * camera.width * camera.height
        self.lifted.append((self.name, camera.width))
        ones = torch.ones(work.splats.count, work.channels)
        return Answer(ones, torch.ones(work.splats.count, dtype=torch.float64))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    for name in ("perf_counter", "monotonic"):
        monkeypatch.setattr(side_by_side.time, name, clock)
    return clock


def test_rounds_are_in_turns_and_a_slow_peer_stops_within_its_time(clock: Clock) -> None:
    log: list[tuple[str, int]] = []
    peers = [Slow("a", clock, 1e-3), Slow("b", clock, 3e-3)]
    for peer in peers:
        peer.lifted = log
    runs = side_by_side.side_by_side(peers, room(TINY, 1), Limits(rounds=3, peer_s=8.0), TINY)
    assert [name for name, _ in log] == ["a", "b", "a", "b", "a"]
    assert runs["a"].seconds == pytest.approx([1.2] * 3)
    assert runs["b"].seconds == pytest.approx([3.6] * 2)


def test_what_would_take_too_long_is_not_run_and_said_so(clock: Clock) -> None:
    axis = Axis("pixels", tuple(replace(TINY, width=w) for w in (20, 40, 80, 160)), lambda size: size.width * 30)
    fast, slow = Slow("fast", clock, 1e-6), Slow("slow", clock, 1e-3)
    under_way = Comparison([fast, slow], 1, Limits(rounds=1, lift_s=3.0))
    base = under_way.table("Base", TINY, {}, 3.0)
    grown = under_way.growth(axis, base)
    assert [run.size.width for run in grown["fast"]] == [20, 40, 80, 160]
    assert [run.size.width for run in grown["slow"]] == [20, 40, 80]
    assert {width for _, width in slow.lifted} == {20, 40, 80}
    (cut,) = under_way.cuts
    assert "slow" in cut and "4,800" in cut and "2.4 s" in cut


def test_nothing_begins_when_the_time_of_all_is_over(clock: Clock) -> None:
    under_way = Comparison([Slow("a", clock, 1.0)], 1, Limits(rounds=1, total_s=5.0), started=0.0)
    base = under_way.table("Small", TINY, {}, 1e9)
    assert under_way.table("Large", TINY, base, 1e9) == {}
    assert "everybody at Large" in under_way.cuts[0]


class Large:
    """A peer that needs 100 MB, and for its first lift something else."""

    name, computes, lifts = "large", "nothing", 0

    def missing(self) -> str:
        return ""

    def lift(self, work: Work) -> Answer:
        self.lifts += 1
        time.sleep(1.0 if self.lifts == 1 else 0.0)
        return Answer(torch.ones(25_000_000)[:1, None], torch.ones(1))


ROOT = Path(__file__).parents[3]
ALONE = """
import json, sys
from tests.benchmarks.peers import child
from tests.benchmarks.peers.everybody import TINY
from tests.unit.measure.test_peers import Large
child.PEERS = (Large(),)
print(json.dumps(child.measured("large", vars(TINY))))
"""


def test_a_process_tells_the_memory_of_a_lift_and_what_the_first_one_costs() -> None:
    # In a process of its own, as in use: one that ran other tests may hold 100 MB at hand, and would not grow.
    done = subprocess.run([sys.executable, "-c", ALONE], cwd=ROOT, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert 90e6 < found["peak_bytes"] - found["before_bytes"] < 200e6
    assert found["first_s"] - found["again_s"] > 0.5


def test_the_page_has_every_part_and_tells_who_was_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    figures = {"first_s": 3.0, "again_s": 1.0, "before_bytes": 2.0**20, "peak_bytes": 3.0 * 2**20}
    monkeypatch.setattr(command, "alone", lambda name, size, cold=False: figures)
    axis = Axis("pixels", (TINY, replace(TINY, width=400)), lambda size: size.width * size.height)
    sizes = Sizes(TINY, TINY, replace(TINY, width=80), (axis, axis, axis, axis))
    absent = Slow("absent", clock, 0.0)
    monkeypatch.setattr(absent, "missing", lambda: "it is not installed")
    peers = (Slow("splatlift", clock, 1e-6), Slow("slow", clock, 1e-3), absent)
    command.write(command.compare(peers, sizes, Limits(rounds=2)), tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    for part in ("## Side by side", "## Growth", "## Memory, and what is paid once", "## Public rasterizers"):
        assert part in page
    assert "**Small**" in page and "**Base**" in page and "**Large**" in page
    assert "| slow | 1.20 | 1.20 |" in page and "| 1000.0 |" in page  # seconds, and times ours
    assert "| 12,000 | 0.012 | - |" in page  # cut off, and no figure in its place
    assert "- slow at pixels 12,000: its last smaller lift took 1.2 s" in page
    assert "**absent** did not take part: it is not installed." in page
    assert (
        "| splatlift | 1 | 3 | 2 | 2.0 | 2.0 |" in page and "| slow | 1 | 3 | 2 | 2.0 | nothing to compile |" in page
    )
    assert (tmp_path / "images" / "peers.png").read_bytes().startswith(b"\x89PNG")


def test_every_axis_holds_the_base_and_ascends() -> None:
    assert PEERS[0].name == Ours.name
    for axis in SIZES.axes:
        grown = [axis.of(size) for size in axis.sizes]
        assert SIZES.base in axis.sizes and grown == sorted(set(grown))
