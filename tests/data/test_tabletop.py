"""The bars on the tabletop scene: what lifts of right masks, of wrong ones and of grids find there."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

import liftcore as lc
from liftcore.features.prompts import prompt_views
from liftcore.query.ask import ask
from liftcore.query.question import Query
from liftcore.query.render import view_mask
from liftcore.query.segment import segment
from liftcore.query.terms import SplatTerm
from liftcore.text.table import TableEncoder
from liftcore.values.pack import read_features, write_pack
from tests.benchmarks.base import read_pack
from tests.benchmarks.consensus import ranked
from tests.benchmarks.objects import measure_lift
from tests.benchmarks.tabletop import CASES, Case, Truth, tabletop

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

ROUNDING = 0.0005 + 1e-9  # of three printed digits
SHORT = ("features_hard", "grids")  # python -m tests.benchmarks.tabletop measures all
BARS = [case for case in CASES if case.pack in SHORT and case.accuracy is not None and case.power == 1]
TOLERANCE = 0.001
OBJECTS, CLOTH, CURTAIN = range(12), 12, 13


@pytest.fixture(scope="module")
def folder(shared_data: Path) -> Path:
    return shared_data / "tabletop"


@pytest.fixture(scope="module")
def truth(folder: Path) -> Truth:
    return tabletop(folder)


@pytest.fixture(scope="module")
def encoder(folder: Path) -> TableEncoder:
    return TableEncoder.open(folder / "text_table.safetensors")


@pytest.fixture(scope="module")
def default_lift(truth: Truth, folder: Path) -> lc.LiftResult:
    """The lift of masks that are mostly right, by default; every fourth view."""
    return truth.lift(read_pack(folder, "features", stride=4))


@pytest.fixture(scope="module")
def hard(truth: Truth, folder: Path) -> lc.LiftResult:
    """The lift of masks of which many are wrong, by default; every fourth view."""
    return truth.lift(read_pack(folder, "features_hard", stride=4))


def test_the_splats_that_count_are_those_of_the_data_readme(truth: Truth) -> None:
    share = float(truth.evaluated.float().mean())
    assert share == pytest.approx(0.9056, abs=5e-4)


@pytest.fixture(scope="module")
def lift_of(truth: Truth, folder: Path) -> Callable[[Case], lc.LiftResult]:
    """The lift of a row of the data README, with all views; each once."""
    return cache(lambda case: truth.lift(read_pack(folder, case.pack), **case.values))


@pytest.mark.parametrize("case", BARS, ids=lambda case: case.name)
def test_a_row_sum_lift_reaches_the_baseline(
    truth: Truth, lift_of: Callable[[Case], lc.LiftResult], case: Case
) -> None:
    """At least those of the data README, to the digits that it prints."""
    assert case.accuracy is not None
    assert case.miou is not None
    got = truth.evaluate(lift_of(case))
    assert got.accuracy >= case.accuracy - ROUNDING
    assert got.miou >= case.miou - ROUNDING


def test_hard_masks_gain_and_confidence_tells_right_from_wrong(truth: Truth, hard: lc.LiftResult) -> None:
    figures = truth.evaluate(hard)
    assert figures.accuracy > 0.893  # .818 with row-sum, .862 with a robust step
    assert figures.miou > 0.894  # .834 and .878
    assert hard.confidence is not None
    assert ranked(truth, hard, hard.confidence) > 0.8


def test_masks_that_are_mostly_right_lose_nothing_by_the_default(
    truth: Truth, folder: Path, default_lift: lc.LiftResult
) -> None:
    row_sum = truth.evaluate(truth.lift(read_pack(folder, "features", stride=4), preset="row-sum"))
    figures = truth.evaluate(default_lift)
    assert figures.accuracy >= row_sum.accuracy - TOLERANCE
    assert figures.miou >= row_sum.miou - TOLERANCE
    assert default_lift.confidence is not None
    assert ranked(truth, default_lift, default_lift.confidence) > 0.8


def test_the_objects_of_hard_masks_are_the_things_of_the_scene(
    truth: Truth, lift_of: Callable[[Case], lc.LiftResult], encoder: TableEncoder
) -> None:
    scene = truth.open_scene(lift_of(BARS[0]))
    answers = {number: ask(scene, truth.words[number], encoder) for number in OBJECTS}
    measures = measure_lift(scene, answers, truth.objects.numpy())
    assert measures["one"] == measures["things"] == 12
    assert measures["box"] > 0.93 and measures["worst"] > 0.85  # .059 around all selected splats
    assert measures["middle"] < 0.01
    assert measures["apart"] == measures["pairs"] == 66


def test_fourteen_words_are_found_among_many(
    truth: Truth, default_lift: lc.LiftResult, encoder: TableEncoder
) -> None:
    scene, real = truth.open_scene(default_lift), truth.objects.numpy()
    words = list(truth.words)
    other_words = [word for word in encoder.words if word not in words]
    absent = np.random.default_rng(0).choice(other_words, 100, replace=False).tolist()
    segmentation = segment(scene, words + absent, encoder.encode(words + absent))
    assert {label.word for label in segmentation.named_words} == set(words)
    mask = scene.has_feature & (scene.total_weight > 0.5)
    assert (segmentation.labels == real)[mask].mean() > 0.9
    seven = segment(scene, words[:7], encoder.encode(words[:7])).labels
    assert (seven[mask & (real >= 7)] < 0).mean() > 0.5


def test_a_thing_stays_found_when_something_else_is_not_wanted(truth: Truth, default_lift: lc.LiftResult) -> None:
    scene, real = truth.open_scene(default_lift), truth.objects.numpy()
    best = [int(np.argmax(np.where(real == number, scene.total_weight, -1.0))) for number in range(CURTAIN + 1)]

    def iou(number: int, *unlike: int) -> float:
        """Of the splats found with those of the thing, asked by the splat of each class that was seen best."""
        like, *against = (SplatTerm(best[other]) for other in (number, *unlike))
        selected, expected = (
            ask(scene, Query.of((like,), tuple(against))).selected,
            (real == number) & scene.has_feature,
        )
        return float((selected & expected).sum() / (selected | expected).sum())

    ious = np.array([iou(number) for number in OBJECTS])
    assert ious.mean() > 0.9
    cases: list[Any] = [(CLOTH,), (CURTAIN,), (CLOTH, CURTAIN), None]  # None: the next thing
    for unlike in cases:
        against = np.array([iou(number, *(unlike or ((number + 1) % len(OBJECTS),))) for number in OBJECTS])
        assert (against > ious - 0.01).all(), unlike


def test_things_are_found_in_the_words_of_their_masks(
    truth: Truth, folder: Path, encoder: TableEncoder, tmp_path: Path
) -> None:
    """Regions of real photos become a picture a word and view: the cloth and the curtain have none."""
    packs, vectors = read_features(folder / "features_clean.safetensors"), encoder.encode(truth.words)
    for view in packs.views[::4]:
        regions = packs[view]
        assert isinstance(regions, lc.Regions)
        nearest = np.append((regions.codebook.float().numpy() @ vectors.T).argmax(axis=1), -1)
        labels = nearest[regions.labels[0].numpy()]
        for number in set(np.unique(labels).tolist()) & {*OBJECTS}:
            (tmp_path / truth.words[number]).mkdir(exist_ok=True)
            Image.fromarray(labels == number).save(tmp_path / truth.words[number] / f"{view}.png")
    views = prompt_views(tmp_path)
    write_pack(tmp_path / "pack", views.views, {}, table=views.table)
    scene = truth.open_scene(truth.lift(read_features(tmp_path / "pack"), preset="row-sum"))
    for number in OBJECTS:
        answer, ious = ask(scene, truth.words[number]), []
        for view, mask in truth.held_out.items():
            visible, right = view_mask(scene, answer, view).mask, (mask == number).numpy()
            ious.append((visible & right).sum() / (visible | right).sum() if right.any() else 1.0)
        assert np.mean(ious) >= 0.95, (truth.words[number], ious)
