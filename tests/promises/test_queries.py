"""Answers of a scene: which splats and pixels are selected, what is there at all, and which part is meant."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import liftcore as lc
import numpy as np
import pytest
import torch

from tests.promises.tiny_files import photo_vectors, scene_with, write_files, write_lift, write_table
from tests.tiny_scene import HEIGHT, SPLATS_A_CLUSTER, labels, ply, splat_rows

CLUSTER = np.repeat(np.arange(3), SPLATS_A_CLUSTER)


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The lifted tiny scene: apple, book and lamp side by side."""
    return write_lift(tmp_path_factory.mktemp("queries"))


@pytest.fixture(scope="module")
def photo_scene() -> lc.Scene:
    """A cat, a boat and a pizza of twenty splats each, with vectors as of photos."""
    return scene_with(photo_vectors(["cat"] * 20 + ["boat"] * 20 + ["pizza"] * 20, 0.25))


@pytest.fixture(scope="module")
def mug(lift: Path) -> lc.Scene:
    """A mug with a handle above, a cat and a curtain: masks of parts and of wholes."""
    splats, cameras = lc.read_splats(lift.parent / "s.ply"), lc.read_cameras(lift.parent / "c.json")
    vectors = torch.from_numpy(photo_vectors(["mug", "cat", "curtain", "handle", "mug"], 0.02)).float()
    upper = np.arange(HEIGHT)[:, None] < HEIGHT // 2
    views = {}
    for name, (wholes,) in labels().items():
        parts = np.where(wholes == 0, np.where(upper, 3, 4), wholes)
        views[name] = lc.Regions(torch.from_numpy(np.stack([parts, wholes]).astype(np.int32)), vectors)
    return lc.Scene(lc.lift(splats, cameras, views, progress=False), splats, cameras)


def with_scores(scores: Sequence[float] | np.ndarray, folder: Path) -> tuple[lc.Scene, str]:
    """Return a scene whose splats have these cosines to the word "x", and the word's encoder."""
    cosines = np.asarray(scores)
    encoder = write_table(folder / "x.safetensors", ["x"], np.eye(1, 4))
    rows = np.stack([cosines, np.sqrt(1 - cosines**2), 0 * cosines, 0 * cosines], axis=1)
    return scene_with(rows), encoder


@pytest.mark.parametrize("words", [["cup"], ["cup", "mug"]])
def test_one_word_written_twice_does_not_compete_with_itself(words: list[str], tmp_path: Path) -> None:
    cup, sofa, other = np.eye(3, 8)
    rows = np.repeat([cup, sofa], 40, axis=0) + 0.02 * np.random.default_rng(3).normal(size=(80, 8))
    vectors = [cup, cup + 1e-3 * other]  # as another rounding of one vector
    table = write_table(tmp_path / "words.safetensors", words, np.stack(vectors[: len(words)]))
    answer = scene_with(rows).ask(lc.Query(text=["cup"]), encoder=table)
    assert np.array_equal(answer.selected, np.arange(80) < 40)


def test_scene_without_a_feature_selects_nothing_by_an_example() -> None:
    answer = scene_with(np.zeros((12, 4)), weights=np.zeros(12)).ask(
        lc.Query.model_validate({"like": [[1, 0, 0, 0]]})
    )
    assert answer.count == 0 and not answer.selected.any()


def test_scores_are_cosines_and_negatives_only_take_away(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows, vectors = rng.normal(size=(30, 16)), rng.normal(size=(2, 16))
    encoder = write_table(tmp_path / "two.safetensors", ["x", "y"], vectors)
    cosines = rows @ vectors.T / np.linalg.norm(rows, axis=1, keepdims=True) / np.linalg.norm(vectors, axis=1)
    relevancy = 1 / (1 + np.exp(10 * (cosines[:, 1] - cosines[:, 0])))
    questions = {"x": cosines[:, 0], "both": cosines.max(axis=1), "not y": cosines[:, 0] * relevancy}
    terms = {"x": (["x"], []), "both": (["x", "y"], []), "not y": (["x"], ["y"])}
    for scale in (1.0, 2.0 ** rng.integers(-3, 4, (30, 1))):  # lengths of features do not count
        scene = scene_with(rows * scale)
        for name, expected in questions.items():
            text, negatives = terms[name]
            answer = scene.ask(lc.Query(text=text, negatives=negatives, threshold=-1.0), encoder=encoder)
            np.testing.assert_allclose(answer.scores, expected, atol=1e-5)


def test_automatic_threshold_lies_between_two_hills(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scores = np.concatenate([rng.normal(0.2, 0.02, 900), rng.normal(0.5, 0.02, 300)])
    for method in ("auto", "paper"):
        scene, encoder = with_scores(scores, tmp_path)
        answer = scene.ask(lc.Query.model_validate({"text": ["x"], "threshold": method}), encoder=encoder)
        assert 0.27 < answer.threshold.value < 0.43 and np.flatnonzero(answer.selected).tolist() == list(
            range(900, 1200)
        )
    by_number = scene.ask(lc.Query(text=["x"], threshold=0.51), encoder=encoder)
    assert np.array_equal(by_number.selected, by_number.scores >= np.float32(0.51)) and 0 < by_number.count < 300


def test_paper_takes_the_lowest_valley_and_auto_the_topmost(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    hills = ((0.15, 0.008, 5000), (0.2, 0.008, 2000), (0.3, 0.005, 300))
    scene, encoder = with_scores(np.concatenate([rng.normal(*hill) for hill in hills]), tmp_path)
    values = {
        method: scene.ask(
            lc.Query.model_validate({"text": ["x"], "threshold": method}), encoder=encoder
        ).threshold.value
        for method in ("auto", "paper")
    }
    assert 0.16 < values["paper"] < 0.19 and 0.22 < values["auto"] < 0.29


@pytest.mark.parametrize("method", ["auto", "paper", 0.0, -1.0])
def test_equal_scores_select_nothing(method: str | float, tmp_path: Path) -> None:
    scene, encoder = with_scores([0.25] * 60, tmp_path)
    answer = scene.ask(lc.Query.model_validate({"text": ["x"], "threshold": method}), encoder=encoder)
    assert answer.count == 0 and not answer.clear


def test_splats_nearer_to_another_word_are_left_to_it(tmp_path: Path) -> None:
    rows = np.repeat(np.eye(3, 8), 20, axis=0)
    rows[20:40, 0] = 0.9  # nearer to the second word, and much like the first
    rows += 0.01 * np.random.default_rng(0).normal(size=rows.shape)
    words = write_table(tmp_path / "w.safetensors", ["one", "two", "three", "first"], np.eye(8)[[0, 1, 2, 0]])
    answer = scene_with(rows).ask("one", encoder=words)  # "first" is the same word, and takes nothing
    assert np.flatnonzero(answer.selected).tolist() == list(range(20))
    pair = scene_with(rows).ask(lc.Query(text=["one", "two"]), encoder=words)
    assert np.flatnonzero(pair.selected).tolist() == list(range(40))


@pytest.mark.parametrize(("own_splats", "is_named"), [(3, False), (4, True)])
def test_word_is_named_where_a_quarter_of_its_selection_is_its_own(
    own_splats: int, is_named: bool, tmp_path: Path
) -> None:
    axes = np.eye(8)
    rows = np.repeat(
        [(0.9 * axes[0] + 0.95 * axes[1]) / np.hypot(0.9, 0.95), 0.7 * axes[0] + np.sqrt(0.51) * axes[3], axes[4]],
        [10, own_splats, 40],
        axis=0,
    )
    table = write_table(tmp_path / "words.safetensors", ["one", "nearer"], axes[:2])
    labels = scene_with(rows).segment(["one", "nearer"], encoder=lc.open_encoder(table))
    assert {word.word for word in labels.named_words} == ({"one", "nearer"} if is_named else {"nearer"})


def test_thin_object_does_not_select_the_scene() -> None:
    words = ["cat"] * 21 + ["cow"] * 2320 + ["curtain"] * 659
    answer = scene_with(photo_vectors(words, 0.2)).ask("cat", encoder="lvis")
    assert 4 < answer.count < 63 and answer.selected[:21].sum() > answer.count / 2


def test_words_are_present_where_splats_are_nearest_to_them(photo_scene: lc.Scene) -> None:
    for number, word in enumerate(("cat", "boat", "pizza")):
        answer = photo_scene.ask(word, encoder="lvis")
        assert answer.present and answer.count >= 10
        assert (CLUSTER[answer.selected] == number).mean() > 0.9
    absent = lc.open_encoder("lvis")
    for word in ("sofa", "lamp", "mug", "zebra"):
        answer = photo_scene.ask(word, encoder=absent)
        assert answer.present is False and answer.count == 0
        assert photo_scene.ask(lc.Query(text=[word], absent="keep"), encoder=absent).count > 0
    combined = photo_scene.ask(lc.Query(text=["sofa", "cat"]), encoder=absent)
    assert np.array_equal(combined.selected, photo_scene.ask("cat", encoder=absent).selected)


@pytest.mark.parametrize("text", ["handle", "mug handle", "the mug's handle"])
def test_a_part_is_selected_by_its_own_node(mug: lc.Scene, text: str) -> None:
    answer = mug.ask(text, encoder="lvis")
    heights = mug.splats.means[:SPLATS_A_CLUSTER, 1].numpy()
    assert set(CLUSTER[answer.selected]) == {0}
    assert np.array_equal(answer.selected[:SPLATS_A_CLUSTER], heights > 0)
    assert mug.ask("handle of the cat", encoder="lvis").present is False
    assert mug.ask("mug", encoder="lvis").count == SPLATS_A_CLUSTER


def test_a_click_may_mean_the_part_or_the_whole(mug: lc.Scene) -> None:
    part, complete_content = mug.ask(lc.Query(like=["middle:6,6"])).candidates
    assert (part.kind, part.splats, complete_content.kind, complete_content.splats) == (
        "part",
        10,
        "object",
        SPLATS_A_CLUSTER,
    )
    for candidate in (part, complete_content):
        answer = mug.ask(lc.Query(sets=[candidate.set]))
        assert answer.count == candidate.splats and set(CLUSTER[answer.selected]) == {0}
    assert mug.ask(lc.Query(like=["splat:0"], unlike=["splat:2"])).candidates[0].kind == "part"


def test_mask_is_where_the_rendered_selection_is_above_a_half(lift: Path) -> None:
    scene = lc.Scene(lift)
    answer = scene.ask("apple", encoder=f"table:{lift.parent / 'words.safetensors'}")
    for view in ("left", "right"):
        selected = lc.render(scene.splats, scene.cameras[view], torch.from_numpy(answer.selected).float())
        scores = lc.render(scene.splats, scene.cameras[view], torch.from_numpy(answer.scores))
        assert np.array_equal(scene.mask(answer, view), np.asarray(selected) > 0.5) and scene.mask(answer, view).any()
        np.testing.assert_allclose(scene.view_mask(answer, view).attention, np.asarray(scores), atol=1e-6)


def test_selections_by_hand_are_asked_as_they_are(lift: Path) -> None:
    scene = lc.Scene(lift)
    selection = scene.select("mine", torch.from_numpy(CLUSTER == 0)).edit("add", CLUSTER == 2).undo()
    assert np.array_equal(scene.ask(lc.Query(sets=["selection:mine"])).selected, CLUSTER == 0)
    assert np.array_equal(selection.redo().splats, CLUSTER != 1)
    assert [group.splats for group in scene.objects(lc.Query(sets=["selection:mine"])).objects] == [
        40
    ]  # one of its own


@pytest.mark.parametrize("notation", [
    "", ":1,2", "v:1.5,2", "v:1", "splat:-1", "region:v:1", "v:box:1,2", "v:box:1,2,3", "v:box:1,2,3,inf",
    "v:stroke:1,2,3",
])  # fmt: skip
def test_notation_of_no_example_is_refused(notation: str, lift: Path) -> None:
    with pytest.raises(lc.InvalidQuery, match="like"):
        lc.Scene(lift).ask(lc.Query(like=[notation]))


def test_splats_that_no_region_meets_are_named_by_no_word(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    rows = splat_rows()
    rows[:, 7:10] = 88.0  # log scales: each splat is larger than any float
    files["splats"].write_bytes(ply(rows))
    settings = lc.LiftSettings.of(preset="tikhonov")
    lift = lc.lift_files(files["splats"], files["cameras"], [files["features"]], settings)
    scene = lc.Scene(lift, splats=files["splats"], cameras=files["cameras"])
    words = scene.segment(["apple", "lamp"], encoder=lc.open_encoder(f"table:{files['table']}"))
    assert words.summary.none == words.summary.splats == len(rows)
