"""Names of queries and answers before they were renamed: Python and the command line still read them."""

import json
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import liftcore as lc
from liftcore import cli, models
from liftcore.text.table import TableEncoder
from tests.tiny_scene import CHANNELS, text_table

AXES = TableEncoder("axes", ("x", "y", "z"), np.eye(3, CHANNELS, dtype=np.float32))


@contextmanager
def deprecated(new: str) -> Iterator[None]:
    with pytest.warns(DeprecationWarning, match=rf"is now {new}$"):
        yield


def test_old_attributes_are_the_new_ones_with_a_warning(scene: lc.Scene) -> None:
    answer = scene.ask("x", encoder=AXES)
    pairs: list[tuple[Any, str, str]] = [
        (answer, "why", "reason"), (answer.query, "weigh", "weight_by"),
        (scene.objects(answer), "strays", "unassigned_splats"), (scene.objects(answer), "found", "objects"),
        (scene.segment(["x", "y"], encoder=AXES), "found", "named_words"),
        (scene.segment(["x", "y"], encoder=AXES).summary, "words", "word_count"),
        (scene.askable(encoder=AXES), "here", "scene_words"),
        (scene.askable(encoder=AXES), "any_text", "open_vocabulary"),
        (models.Edit(operation="grow"), "how", "operation"), (lc.Picture(channel="pca"), "what", "channel"),
        (lc.load_lift(scene.path).query(np.eye(CHANNELS)[0]), "why", "reason"),
        (scene, "look", "view_mask"), (scene, "what", "nearest_words"), (scene, "counted", "splat_weights"),
        (scene, "seen_alone", "weights_with_feature"), (answer, "dropped", "is_dropped"),
        (scene, "all_seen", "all_have_features"),
        (models.Edit(operation="grow"), "described", "to_json"),
    ]  # fmt: skip
    for value, old, new in pairs:
        with deprecated(new):
            assert getattr(value, old) == getattr(value, new)


def test_old_keywords_and_fields_are_read_and_contradictions_are_refused(scene: lc.Scene) -> None:
    answer = scene.ask("x", encoder=AXES)
    query: Any = lc.Query
    edit: Any = models.Edit
    assert query(text="x", weigh="confidence") == query(text="x", weight_by="confidence")
    assert edit(how="grow") == edit(operation="grow", how="grow") == edit(operation="grow")
    assert lc.Answer.model_validate(scene.ask("x", encoder=AXES).model_dump()).reason
    assert query(text="x", weight_by="evidence").weight_by == "total_weight"
    assert query(text="x", weigh="evidence", weight_by="total_weight") == query(text="x")
    assert np.array_equal(scene.splat_weights("evidence"), scene.splat_weights("total_weight"))
    selection: Any = scene.select("mine")
    with deprecated("operation"):
        selection.edit(how="grow")
    with deprecated("channel"):
        assert (scene.render("middle", what="depth") == scene.render("middle", "depth")).all()  # pyright: ignore
    for value in (scene, answer, scene.lift):
        with deprecated("has_feature"):
            assert (value.seen == value.has_feature).all()  # pyright: ignore
    arrays = answer.scores, answer.selected
    fields = {name: getattr(answer, name) for name in lc.Answer.model_fields if name not in ("text", "like", "count")}
    with deprecated("has_feature"):
        old = lc.Answer.of(answer.query, arrays[0], seen=answer.has_feature, selected=arrays[1], **fields)
    assert old.has_feature is answer.has_feature
    view_mask = scene.view_mask(answer, "middle")
    with deprecated("view_mask"):
        old_blocks = scene.blocks_of(answer, "mask", view="middle", seen=view_mask)  # pyright: ignore
    assert [*old_blocks] == [*scene.blocks_of(answer, "mask", view="middle", view_mask=view_mask)]
    wrong: list[tuple[Callable[[], object], str]] = [
        (lambda: query(text="x", weigh="confidence", weight_by="total_weight"), "weight_by"),
        (lambda: edit(how="grow", operation="shrink"), "operation"),
    ]
    for call, argument in wrong:
        with pytest.raises(lc.InvalidQuery, match=r"one value: .* is the old name of") as error:
            call()
        assert error.value.argument == argument
    with pytest.raises(lc.InvalidInput), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        selection.edit(how="grow", operation="shrink")


def test_old_names_of_classes_are_the_new_ones_with_a_warning() -> None:
    with deprecated("SelectedObject"):
        assert lc.FoundObject is lc.SelectedObject  # pyright: ignore[reportAttributeAccessIssue]
    for old, new in (
        ("Found", "SelectionSummary"), ("FoundWords", "LabelSummary"), ("AskableWords", "SuggestedWords"),
        ("Seen", "Viewpoint"),
    ):  # fmt: skip
        with deprecated(new):
            assert getattr(models, old) is getattr(models, new)
        assert old not in models.__all__
    for module in (lc, models):
        with pytest.raises(AttributeError):
            module.NeverThere  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


def test_old_options_are_read_noted_and_refused_where_they_contradict(
    tiny_lift: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*words: object) -> tuple[int, str, str]:
        try:
            status = cli.main([*map(str, words)])
        except SystemExit as error:
            status = int(str(error.code))
        out, err = capsys.readouterr()
        return status, out, err

    cases = (
        (("query", tiny_lift, "--like", "splat:1"), "--weigh", "--weight-by", ("total_weight", "confidence")),
        (
            ("render", tiny_lift, "--view", "middle", "-o", tmp_path / "view.png"),
            "--what",
            "--channel",
            ("pca", "rgb"),
        ),
    )
    for command, old, new, (value, other) in cases:
        status, expected, _ = run(*command, new, value, "--json")
        assert status == 0
        status, output, note = run(*command, old, value, "--json")
        assert (status, output) == (0, expected) and old in note and new in note
        assert run(*command, old, value, new, value)[0] == 0
        for words in ((old, value, new, other), (new, value, old, other)):
            status, _, error = run(*command, *words)
            assert status == cli.BAD_INPUT and old in error and new in error
        assert old not in run(command[0], "--help")[1].replace(new, "").split()
    by_weight = [
        run("query", tiny_lift, "--like", "splat:1", "--weight-by", value, "--json")[:2]
        for value in ("total_weight", "evidence")
    ]
    assert by_weight[0] == by_weight[1] and by_weight[0][0] == 0
    words = tmp_path / "words.txt"
    words.write_text("apple\nlamp\n")
    (tmp_path / "table.safetensors").write_bytes(text_table())
    segment = ("segment", tiny_lift, "--table", tmp_path / "table.safetensors", "--words", words, "--json")
    new, old = (json.loads(run(*segment, flag, "splat:1")[1]) for flag in ("--example", "--what"))
    assert new == old and len(new["examples"]) == 1
    documents = json.loads(run(*segment, "--example", "splat:1", "--what", "splat:2")[1])
    assert [item["example"] for item in documents["examples"]] == ["splat:1", "splat:2"]
