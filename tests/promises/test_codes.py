"""A lift as codes: two bytes a splat and rows of features, of which questions have the answers of exact features."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import liftcore as lc
import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from tests.promises.tiny_files import photo_vectors, row_of_splats, scene_with

COUNT = 6_000
WORDS = ("cat", "boat", "pizza", "mug", "curtain")
REGIONS = 20  # of each word


def lift_with(features: np.ndarray, has_feature: np.ndarray | None = None) -> lc.LiftResult:
    """Return a lift with features [P, F], and total weights from one to nine where splats have one."""
    has_feature = np.ones(len(features), bool) if has_feature is None else has_feature
    lift = scene_with(features[:12]).lift
    rows, weights = torch.from_numpy(features).half(), torch.linspace(1.0, 9.0, len(features))
    columns = {"total_weight": weights * torch.from_numpy(has_feature), "confidence": weights / 10}
    columns |= {"rows": rows, "has_feature": torch.from_numpy(has_feature)}
    metadata = lift.metadata.model_copy(update={"landmarks": (), "diagnostics": {"masks": True}})
    return lc.LiftResult.of(replace(lift, **columns, metadata=metadata))


@pytest.fixture(scope="module")
def exact() -> lc.LiftResult:
    """A lift of masks: each splat has a mixture of two of its thing's regions; a hundredth has no feature."""
    rng = np.random.default_rng(1)
    clusters = rng.integers(0, len(WORDS), COUNT)
    regions = photo_vectors([word for word in WORDS for _ in range(REGIONS)], 0.3).reshape(len(WORDS), REGIONS, -1)
    first, second = (regions[clusters, rng.integers(0, REGIONS, COUNT)] for _ in range(2))
    share, has_feature = rng.choice([0.0, 0.3, 0.5], (COUNT, 1)), np.arange(COUNT) % 100 != 7
    return lift_with(np.where(has_feature[:, None], (1 - share) * first + share * second, 0.0), has_feature)


@pytest.fixture(scope="module")
def coded(exact: lc.LiftResult) -> lc.LiftResult:
    return exact.as_codes()


def expanded(lift: lc.LiftResult) -> lc.LiftResult:
    """Return a lift as codes with a row a splat."""
    return replace(lift, rows=lift.features, code=None)


def test_codes_answer_as_exact_features_do(exact: lc.LiftResult, coded: lc.LiftResult) -> None:
    assert coded.code is not None and coded.code.dtype == torch.uint16
    facts = coded.diagnostics["codes"]
    assert facts["rows"] == len(coded.rows) <= 8_192 and facts["loss"] < 0.05
    assert len(coded) == COUNT and f"{COUNT} splats" in repr(coded)
    for word in (*WORDS, "sofa", "zebra"):
        exact_answer, answer, full_answer = (
            lift.query(word, encoder="lvis") for lift in (exact, coded, expanded(coded))
        )
        assert np.array_equal(answer.selected, full_answer.selected) and answer.threshold == full_answer.threshold
        assert answer.present == exact_answer.present, word
        assert (answer.selected != exact_answer.selected).mean() < 0.02, word
        assert answer.count == exact_answer.count == 0 or word in WORDS
    scores = coded.query("cat", encoder="lvis").scores
    assert np.abs(scores - exact.query("cat", encoder="lvis").scores)[exact.has_feature.numpy()].max() < 0.1
    assert (scores[~exact.has_feature.numpy()] == -1).all()


def test_codes_are_labelled_clicked_and_named_as_their_rows_are(coded: lc.LiftResult) -> None:
    columns = {"object": torch.arange(COUNT).int() % 5, "object_views": torch.zeros(5, 5).int()}
    lifts = [replace(lift, **columns) for lift in (coded, expanded(coded))]
    of_codes, of_rows = (lc.Scene(lift, row_of_splats(COUNT)) for lift in lifts)
    labels, expected = (scene.segment([*WORDS, "sofa"], encoder="lvis") for scene in (of_codes, of_rows))
    assert np.array_equal(labels.rows, expected.rows) and (labels.rows >= 0).mean() > 0.8
    clicked, expected = (scene.ask(lc.Query(like=["splat:5"]), places=False) for scene in (of_codes, of_rows))
    assert expected.count and np.array_equal(clicked.selected, expected.selected)
    vectors = lc.open_encoder("lvis").encode(list(WORDS))
    listing, expected = (scene.tree(WORDS, vectors) for scene in (of_codes, of_rows))
    assert [item.name for item in listing.objects] == [item.name for item in expected.objects]
    assert [item.score for item in listing.objects] == pytest.approx(
        [item.score for item in expected.objects], abs=1e-5
    )


def test_codes_have_the_same_bits_for_any_threads(
    exact: lc.LiftResult, coded: lc.LiftResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = torch.get_num_threads()
    for count in (1, 3):
        torch.set_num_threads(count)
        monkeypatch.setattr("liftcore.solve.codes.cores", lambda count=count: count)
        coded_again = exact.as_codes()
        torch.set_num_threads(threads)
        for name in ("code", "features"):
            assert np.array_equal(coded_again.arrays()[name], coded.arrays()[name])


def test_codes_are_saved_read_cropped_and_moved_as_codes(
    coded: lc.LiftResult, exact: lc.LiftResult, tmp_path: Path
) -> None:
    for name, lift in (("coded", coded), ("exact", exact)):
        lift.save(tmp_path / f"{name}.safetensors", features="codes")
    read = lc.load_lift(tmp_path / "coded.safetensors")
    assert (tmp_path / "coded.safetensors").read_bytes() == (tmp_path / "exact.safetensors").read_bytes()
    for name, column in coded.arrays().items():
        assert np.array_equal(read.arrays()[name], column) and read.arrays()[name].dtype == column.dtype, name
    code, read_code = coded.arrays()["code"], lc.Scene(tmp_path / "coded.safetensors").features.code
    assert read_code is not None and np.array_equal(read_code, code)
    for lift in (read, coded):
        cropped = lift[100:700]
        assert np.array_equal(cropped.arrays()["code"], code[100:700]) and len(cropped) == 600
    larger = read.transformed(np.diag([2.0, 2.0, 2.0, 1.0]))
    assert np.array_equal(larger.arrays()["code"], code)


def test_columns_that_do_not_follow_from_others_come_back(coded: lc.LiftResult, tmp_path: Path) -> None:
    views, count = torch.zeros(2, 5).int(), len(coded)
    tree = {"node": torch.arange(count).int() % 3, "node_parents": torch.tensor([-1, -1, 0]).int()}
    tree |= {"node_views": torch.zeros(3, 5).int(), "node_confidence": torch.ones(3), "object_views": views}
    tree |= {"node_features": torch.zeros(3, coded.rows.shape[1]).half(), "object": torch.arange(count).int() % 2}
    lift = replace(coded, has_feature=torch.arange(count) % 5 > 0, **tree)
    lift.save(tmp_path / "odd.safetensors")
    read = lc.load_lift(tmp_path / "odd.safetensors")
    for name in ("has_feature", "object"):
        assert np.array_equal(read.arrays()[name], lift.arrays()[name])


def test_codes_are_saved_as_exact_features_where_these_are_wanted(
    coded: lc.LiftResult, exact: lc.LiftResult, tmp_path: Path
) -> None:
    expected = coded.features
    coded.save(tmp_path / "exact.safetensors", features="exact")
    lc.load_lift(tmp_path / "exact.safetensors").save(tmp_path / "exact.safetensors")  # stays so
    read = lc.load_lift(tmp_path / "exact.safetensors")
    assert read.code is None and torch.equal(read.features, expected)
    exact.save(tmp_path / "coded.safetensors")
    settings = exact.settings.model_copy(update={"codes": False})
    kept = replace(exact, metadata=exact.metadata.model_copy(update={"settings": settings}))
    kept.save(tmp_path / "kept.safetensors")
    assert torch.equal(lc.load_lift(tmp_path / "kept.safetensors").features, exact.features)
    sizes = [(tmp_path / f"{name}.safetensors").stat().st_size for name in ("coded", "exact")]
    assert sizes[0] < 0.4 * sizes[1]
    with pytest.raises(lc.InvalidInput, match="codes"):
        coded.save(tmp_path / "other.safetensors", features="small")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("steps", [float("nan"), float("inf"), 1024.0, None])
def test_bytes_without_steps_that_float16_can_hold_are_refused(
    coded: lc.LiftResult, tmp_path: Path, steps: float | None
) -> None:
    coded.save(tmp_path / "coded.safetensors")
    with safe_open(tmp_path / "coded.safetensors", "pt") as file:
        text = file.metadata()
    tensors = load_file(tmp_path / "coded.safetensors")
    first = tensors.pop("feature_steps")
    if steps is not None:
        tensors["feature_steps"] = torch.where(torch.arange(len(first)) == 3, torch.tensor(steps), first)
    save_file(tensors, tmp_path / "coded.safetensors", text)
    with pytest.raises(lc.InvalidLift, match="feature_steps"):
        lc.load_lift(tmp_path / "coded.safetensors")


def test_an_edited_copy_of_the_splats_takes_their_codes(coded: lc.LiftResult) -> None:
    old = row_of_splats(COUNT)
    keep = np.arange(COUNT) % 3 > 0
    copy = coded.transferred(old, old[keep])
    assert np.array_equal(copy.arrays()["code"], coded.arrays()["code"][keep])


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_labelled_splats_bring_their_codes(coded: lc.LiftResult, tmp_path: Path, suffix: str) -> None:
    # Nearly each splat is an instance, so the document in the .glb is longer than the beginning that readers look at.
    scene, path = lc.Scene(coded, row_of_splats(COUNT)), tmp_path / f"labelled{suffix}"
    scene.export(path, scene.segment(WORDS, encoder="lvis"), "labelled")
    codes = lc.read_splats(path).extras["code"].numpy()
    assert np.array_equal(coded.arrays()["features"][codes], coded.features.numpy())


def test_features_that_share_nothing_or_differ_within_things_stay_exact(exact: lc.LiftResult) -> None:
    of_maps = exact.metadata.model_copy(update={"diagnostics": {"masks": False}})
    assert replace(exact, metadata=of_maps).as_codes().code is None
    rng = np.random.default_rng(0)
    for features in (rng.normal(size=(COUNT, 64)), rng.normal(size=(40, 64))):
        lift = lift_with(features)
        saved_lift = lift.as_codes()
        assert saved_lift.code is None and torch.equal(saved_lift.features, lift.features)
        assert saved_lift.diagnostics["codes"]["reason"].startswith("Features are exact: ")
