"""The preset `default` on tabletop: what it gains under wrong masks, and that it costs right ones nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

import liftcore as lc
from liftcore.features.pack import read_features
from tests.benchmarks.consensus import Truth, tabletop_truth
from tests.benchmarks.tabletop import Tabletop

if TYPE_CHECKING:
    from pathlib import Path

NOTHING = 0.001


@pytest.fixture(scope="module")
def truth(shared_data: Path) -> Truth:
    return tabletop_truth(Tabletop(shared_data / "tabletop"))


def lifted(truth: Truth, folder: Path, pack: str, preset: str) -> lc.LiftResult:
    packs = read_features(folder / f"{pack}.safetensors")
    views = {view: packs[view] for view in packs.views[::4]}
    return lc.lift(truth.raster.splats, truth.cameras, views, preset=preset, certificate_rays=0)


def test_hard_masks_gain_and_confidence_tells_right_from_wrong(truth: Truth, shared_data: Path) -> None:
    found = lifted(truth, shared_data / "tabletop", "features_hard", preset="default")
    accuracy, miou, _ = truth.judge(found)
    assert accuracy > 0.893  # .818 with row-sum, .862 with a robust step
    assert miou > 0.894  # .834 and .878
    assert found.confidence is not None
    assert truth.ranked(found, found.confidence) > 0.8
    assert truth.ranked(found, found.agreement) < 0.5  # which is not what it is for


def test_masks_that_are_mostly_right_lose_nothing(truth: Truth, shared_data: Path) -> None:
    plain = lifted(truth, shared_data / "tabletop", "features", preset="row-sum")
    found = lifted(truth, shared_data / "tabletop", "features", preset="default")
    (accuracy, miou, _), (before, shown, _) = truth.judge(found), truth.judge(plain)
    assert accuracy >= before - NOTHING
    assert miou >= shown - NOTHING
    assert found.confidence is not None
    assert truth.ranked(found, found.confidence) > 0.8
