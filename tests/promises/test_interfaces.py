"""Python, the command line, GET and POST answer alike, field by field: each is a view of the same library."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import liftcore as lc
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from liftcore import cli

from tests.promises.command_line import run
from tests.promises.tiny_files import write_files
from tests.tiny_scene import HEIGHT, VIEWS, WORDS, make_scene

from .over_http import array, delete_lift, lift_of, picture, upload

EXAMPLES = (
    "middle:6,12", f"middle:26,{HEIGHT // 2}", "splat:0", "splat:47", "middle:box:3,4,10,20",
    "middle:stroke:26,5,26,12,27,19", "object:1", "splat:60", "middle:box:9,9,3,3", "none",
)  # the last three are refused  # fmt: skip
FIELDS: dict[str, st.SearchStrategy[Any]] = {
    "text": st.lists(st.sampled_from((*WORDS, "apples", "zeppelin")), min_size=1, max_size=1),
    "like": st.lists(st.sampled_from(EXAMPLES), min_size=1, max_size=2, unique=True),
    "negatives": st.lists(st.sampled_from((*WORDS, "zeppelin")), max_size=2, unique=True),
    "unlike": st.lists(st.sampled_from(EXAMPLES), max_size=1),
    "sets": st.lists(st.sampled_from(("object:0", "object:2", "object:9", "none")), max_size=2),
    "threshold": st.sampled_from(("auto", "paper", "best")) | st.floats(-1, 1).map(lambda cut: round(cut, 3)),
    "instances": st.integers(1, 4),
    "min_size": st.integers(1, 25),
    "keep": st.sampled_from(("all", "largest", "some")),
    "absent": st.sampled_from(("drop", "keep")),
}
ROWS: list[dict[str, Any]] = [
    {"text": ["apple"], "top": 3},
    {"text": ["apple"], "negatives": ["lamp"], "threshold": 0.25},
    {"like": ["middle:6,12"], "unlike": ["splat:47"]},
    {"like": ["middle:box:3,4,10,20"]},
    {"like": ["middle:stroke:26,5,26,12,27,19"], "keep": "largest"},
    {"like": ["splat:20"], "instances": 1},
    {"like": ["splat:47"], "threshold": -1.0, "min_size": 21},
    {"sets": ["object:0", "object:2"]},
    {"text": ["book"], "threshold": "paper", "absent": "keep"},
]


def questions_with(name: str) -> st.SearchStrategy[dict[str, Any]]:
    """Return questions that have a field, and some of the others."""
    other_items = {other: values for other, values in FIELDS.items() if other != name}
    return st.fixed_dictionaries({name: FIELDS[name]}, optional={**other_items, "top": st.integers(0, 9)})


def document_of(*models: Any) -> dict[str, Any]:
    """Return the fields of models, as JSON has them."""
    return {name: value for model in models for name, value in model.model_dump(mode="json").items()}


class Interfaces:
    """One lift, which the service made of uploads, and which all others read by its downloaded file."""

    def __init__(self, client: httpx.Client, order: dict[str, Any], folder: Path) -> None:
        self.client, self.folder, self.files = client, folder, write_files(folder)
        self.table, self.encoder = upload(client, "table", make_scene().table), f"table:{self.files['table']}"
        self.lift = lift_of(client, order | {"table": self.table})
        self.path = folder / "downloaded.lift.safetensors"
        self.path.write_bytes(client.get(self.lift["links"]["features"]).content)
        self.scene = lc.Scene(self.path, self.files["splats"], self.files["cameras"])

    def get(self, path: str, **parameters: Any) -> Any:
        """Return the reply to a GET about the lift."""
        return self.client.get(path, params={"lift": self.lift["id"], **parameters})

    def post(self, path: str, **body: Any) -> Any:
        """Return the reply to a POST about the lift."""
        return self.client.post(path, json={"lift": self.lift["id"], **body})

    def of_lift(self, path: str, **parameters: Any) -> Any:
        """Return the reply to a GET below the lift's own path."""
        return self.client.get(f"/lifts/{self.lift['id']}/{path}", params=parameters)

    def command(self, name: str, *words: object) -> dict[str, Any] | None:
        """Return the JSON that a command about the lift prints; None where it is refused."""
        lift = [self.path, "--splats", self.files["splats"]]
        lift += [] if name == "objects" else ["--cameras", self.files["cameras"]]
        reply = run(name, *lift, *words, "--json")
        assert reply.status in (0, cli.BAD_INPUT)
        return reply.document if reply.status == 0 else None

    def written_file(self, name: str, option: str, file: str, *words: object) -> bytes:
        """Return the file that an option of a command writes."""
        path = self.folder / file
        assert self.command(name, *words, option, path) is not None
        return path.read_bytes()

    def exported(self, file: str, source: Any, content: str = "", **options: Any) -> bytes:
        """Return the file that the library writes."""
        self.scene.export(self.folder / file, source, content, **options)
        return (self.folder / file).read_bytes()

    def words_of(self, fields: dict[str, Any]) -> list[object]:
        """Return the options of a question, its text first, and of the text table, which only words need."""
        words: list[object] = list(fields.get("text", []))
        for name, value in fields.items():
            flag = {"negatives": "--negative"}.get(name, f"--{name.replace('_', '-')}")
            for item in (value if isinstance(value, list) else [value]) if name != "text" else []:
                words += [flag, item]
        return words + (["--table", self.files["table"]] if {"text", "negatives"} & set(fields) else [])

    def ask(self, fields: dict[str, Any]) -> lc.Answer | None:
        """Return the library's answer; None where it is refused."""
        try:
            return self.scene.ask(lc.Query(**fields), encoder=self.encoder, places=True)
        except lc.SplatliftError:
            return None


@pytest.fixture(scope="module")
def interfaces(
    client: httpx.Client, order: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Interfaces]:
    interfaces = Interfaces(client, order, tmp_path_factory.mktemp("interfaces"))
    yield interfaces
    delete_lift(client, interfaces.lift["id"])
    assert client.delete(f"/assets/{interfaces.table}").status_code == 204


def assert_equal_answers(interfaces: Interfaces, fields: dict[str, Any]) -> None:
    """Ask by all four ways, and compare the answers with their objects; or all four refuse."""
    answer = interfaces.ask(fields)
    expected = None if answer is None else document_of(answer, interfaces.scene.objects(answer))
    question = {name: value for name, value in fields.items() if name != "top"}
    for send in (interfaces.get, interfaces.post):
        replies = [send("/query", **fields), send("/query/objects", **question)]
        assert {reply.status_code for reply in replies} <= ({404, 422} if expected is None else {200})
        if expected is not None:
            document = {name: value for reply in replies for name, value in reply.json().items()}
            assert {name: document[name] for name in expected} == expected
    top = [] if "top" in fields else ["--top", "10"]
    document = interfaces.command("query", *interfaces.words_of(fields), *top, "--objects")
    assert (document and document["answer"]) == expected


@pytest.mark.parametrize("fields", ROWS, ids="-".join)
def test_each_field_of_a_question_has_the_same_answer(interfaces: Interfaces, fields: dict[str, Any]) -> None:
    assert interfaces.ask(fields) is not None
    assert_equal_answers(interfaces, fields)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(fields=st.one_of(questions_with("text"), questions_with("like")))
def test_any_fields_of_a_question_have_the_same_answer(interfaces: Interfaces, fields: dict[str, Any]) -> None:
    assert_equal_answers(interfaces, fields)


@pytest.mark.parametrize("fields", [ROWS[1], ROWS[4]], ids=["words", "click"])
def test_scores_and_selections_are_the_same_arrays(interfaces: Interfaces, fields: dict[str, Any]) -> None:
    answer = interfaces.ask(fields)
    assert answer is not None
    words = interfaces.words_of(fields)
    scores = [array(interfaces.written_file("query", "--scores", "scores.npy", *words))]
    for send in (interfaces.get, interfaces.post):
        scores.append(array(send("/query/scores", **fields).content))
        selected = array(send("/query/selection", **fields).content)
        assert selected.dtype == np.bool_ and np.array_equal(selected, answer.selected)
    assert all(array.dtype == np.float32 and np.array_equal(array, answer.scores) for array in scores)
    assert 0 < answer.count < len(answer.scores)


@pytest.mark.parametrize("fields", [ROWS[1], ROWS[4]], ids=["words", "click"])
def test_masks_and_attention_of_a_view_are_the_same_pictures(interfaces: Interfaces, fields: dict[str, Any]) -> None:
    answer = interfaces.ask(fields)
    words = interfaces.words_of(fields)
    views = []
    for kind in ("mask", "attention"):
        for view in ("left", "right"):
            pictures = [interfaces.exported("picture.png", answer, kind, view=view)]
            pictures += [
                send(f"/query/{kind}", view=view, **fields).content for send in (interfaces.get, interfaces.post)
            ]
            pictures.append(interfaces.written_file("query", f"--{kind}", "picture.png", *words, "--view", view))
            assert all(np.array_equal(picture(content), picture(pictures[0])) for content in pictures)
            views.append(picture(pictures[0]))
        assert not np.array_equal(*views[-2:])
    assert answer is not None and np.array_equal(views[0] > 0, interfaces.scene.mask(answer, "left"))


def test_a_camera_of_no_file_sees_the_same_everywhere(interfaces: Interfaces) -> None:
    middle = lc.read_cameras(interfaces.files["cameras"])["middle"]
    camera = lc.Camera(middle.viewmat, middle.K * [[2], [2], [1]], 2 * middle.width, 2 * middle.height)
    body = {"width": camera.width, "height": camera.height, "fx": camera.fx, "viewmat": camera.viewmat.tolist()}
    pose = np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1, -1, 1])
    frame = {"file_path": "mine.png", "transform_matrix": pose.tolist()}
    document = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "frames": [frame]}
    (interfaces.folder / "mine.json").write_text(json.dumps(document))
    answer = interfaces.ask({"like": ["splat:0"]})
    assert answer is not None
    expected = interfaces.scene.mask(answer, camera)
    over_http = interfaces.post("/query/mask", like=["splat:0"], camera=body)
    options = ("--like", "splat:0", "--camera", interfaces.folder / "mine.json")
    for content in (over_http.content, interfaces.written_file("query", "--mask", "mine.png", *options)):
        assert np.array_equal(picture(content) > 0, expected)
    assert expected.shape == (2 * HEIGHT, 64) and 0 < expected.mean() < 0.5


@pytest.mark.parametrize("channel", lc.Picture.model_json_schema()["properties"]["channel"]["enum"])
def test_renders_of_each_channel_are_the_same_pictures(interfaces: Interfaces, channel: str) -> None:
    options = ("--view", "middle", "--channel", channel)
    try:
        image = picture(interfaces.exported("render.png", None, channel, view="middle"))
    except lc.InvalidQuery:  # the lift has no such values
        assert interfaces.get("/render", view="middle", channel=channel).status_code == 422
        assert interfaces.command("render", *options, "-o", interfaces.folder / "render.png") is None
        return
    over_http = [
        send("/render", view="middle", channel=channel).content for send in (interfaces.get, interfaces.post)
    ]
    for content in (*over_http, interfaces.written_file("render", "-o", "render.png", *options)):
        assert np.array_equal(picture(content), image)
    if channel != "depth":
        assert np.array_equal(image, interfaces.scene.render("middle", channel))


def test_hidden_objects_are_left_out_of_pictures(interfaces: Interfaces) -> None:
    usual, image = (interfaces.scene.render("middle", hide=hide) for hide in ((), ["object:0"]))
    scene = interfaces.scene
    members = scene.ask(lc.Query(sets=["object:0"])).selected
    pixels, rest = (
        lc.render(splats, scene.cameras["middle"], np.ones((splats.count, 1), np.float32)).numpy()[..., 0] > 0
        for splats in (scene.splats[members], scene.splats[~members])
    )
    assert np.array_equal(image[~pixels], usual[~pixels]) and not np.array_equal(image[pixels], usual[pixels])
    assert np.array_equal(scene.render("middle", "depth", hide=["object:0"]) > 0, rest)
    for send in (interfaces.get, interfaces.post):
        assert np.array_equal(picture(send("/render", view="middle", hide=["object:0"]).content), image)


def test_splats_of_an_answer_are_the_same_files(interfaces: Interfaces) -> None:
    fields = {"text": ["lamp"], "threshold": 0.5}
    answer, words = interfaces.ask(fields), interfaces.words_of(fields)
    for name in ("object", "coloured"):
        expected = interfaces.exported("out.ply", answer, name)
        assert interfaces.written_file("query", f"--{name}", "out.ply", *words) == expected
        for send in (interfaces.get, interfaces.post):
            assert send(f"/query/{name}", **fields).content == expected
    count = len(lc.read_splats(interfaces.folder / "out.ply").means)
    assert count == len(interfaces.scene.features)


def test_objects_and_their_tree_are_the_same_lists(interfaces: Interfaces) -> None:
    words = interfaces.scene.words(interfaces.encoder)
    expected = document_of(interfaces.scene.tree(words, encoder=interfaces.encoder))
    document = interfaces.of_lift("tree", table=interfaces.table).json()
    assert {name: document[name] for name in expected} == expected
    output = interfaces.command("objects", "--tree", "--table", interfaces.files["table"])
    assert output is not None and output["answer"] == expected
    assert sorted(node["name"] for node in expected["nodes"]) == sorted(WORDS)
    page = interfaces.of_lift("objects", table=interfaces.table).json()["objects"]
    output = interfaces.command("objects", "--table", interfaces.files["table"])
    assert output is not None
    for listing in (page, output["answer"]["nodes"]):
        nodes = [
            {name: node[name] for name in entry if name in node}
            for entry, node in zip(listing, expected["nodes"], strict=True)
        ]
        assert [{name: entry[name] for name in node} for entry, node in zip(listing, nodes, strict=True)] == nodes
        assert {"id", "name", "splats", "box", "views"} <= set(nodes[0])


def test_splats_of_an_object_are_the_same_file(interfaces: Interfaces) -> None:
    expected = interfaces.exported("object.ply", 1)
    assert interfaces.get("/query/object", sets="object:1").content == expected
    assert interfaces.written_file("export", "-o", "object.ply", "--object", 1) == expected
    assert len(lc.read_splats(interfaces.folder / "object.ply").means) == interfaces.scene.members(1).sum() > 0


def test_labels_of_many_words_are_the_same(interfaces: Interfaces) -> None:
    words = ["lamp", "apple"]
    segmentation = interfaces.scene.segment(words, encoder=interfaces.encoder)
    expected = document_of(segmentation.summary)
    body = {"words": words, "table": interfaces.table}
    document = interfaces.post("/query/segment", **body).json()
    assert {name: document[name] for name in expected} == expected
    (interfaces.folder / "words.txt").write_text("\n".join(words))
    options = ["--words", interfaces.folder / "words.txt", "--table", interfaces.files["table"]]
    output = interfaces.command("segment", *options)
    assert output is not None and output["answer"] == expected
    labelled = interfaces.exported("labelled.ply", segmentation, "labelled")
    assert interfaces.written_file("segment", "--labelled", "labelled.ply", *options) == labelled
    labels = [interfaces.post("/query/segment/labels", **body).content]
    labels.append(interfaces.written_file("segment", "--labels", "labels.npy", *options))
    assert all(np.array_equal(array(content), segmentation.labels) for content in labels)
    assert len(set(segmentation.labels.tolist())) >= len(words)
    maps = [interfaces.post("/query/segment/map", view="left", **body).content]
    maps.append(interfaces.written_file("segment", "--map", "map.png", *options, "--view", "left"))
    maps.append(interfaces.exported("map.png", segmentation, "map", view="left"))
    assert all(np.array_equal(picture(content), picture(maps[0])) for content in maps)


@pytest.mark.parametrize("example", ["splat:0", "middle:16,12"])
def test_nearest_words_of_an_example_are_the_same(interfaces: Interfaces, example: str) -> None:
    nearest = interfaces.scene.nearest_words(example, encoder=interfaces.encoder)
    expected = [document_of(word) for word in nearest]
    assert (
        interfaces.post("/query/nearest_words", example=example, table=interfaces.table).json()["words"] == expected
    )
    options = ("--example", example, "--table", interfaces.files["table"])
    output = interfaces.command("segment", *options)
    assert output is not None and output["examples"] == [{"example": example, "words": expected}]
    assert expected[0]["word"] == {"splat:0": "apple"}.get(example, "book")


@pytest.mark.parametrize(
    ("source", "suffix"),
    [("tree", ".ply"), ("tree", ".json"), ("answer", ".glb"), ("labels", ".json"), ("labels", ".ply")],
)
def test_exports_with_labels_are_those_of_the_library(interfaces: Interfaces, source: str, suffix: str) -> None:
    scene, encoder = interfaces.scene, interfaces.encoder
    (interfaces.folder / "two.txt").write_text("book\nlamp\n")

    options, labelled = {
        "tree": ([], lambda: scene.tree(scene.words(encoder), encoder=encoder)),
        "answer": (["--text", "apple", "--text", "lamp"], lambda: interfaces.ask({"text": ["apple", "lamp"]})),
        "labels": (
            ["--words", interfaces.folder / "two.txt"],
            lambda: scene.segment(["book", "lamp"], encoder=encoder),
        ),
    }[source]
    expected = interfaces.exported(f"out{suffix}", labelled(), "masks" if suffix == ".json" else "labelled")
    table = ("--table", interfaces.files["table"])
    assert interfaces.written_file("export", "-o", f"out{suffix}", *options, *table) == expected
    if suffix == ".json":
        assert {Path(image["file_name"]).stem for image in json.loads(expected)["images"]} == set(VIEWS)
    else:
        assert len(lc.read_splats(interfaces.folder / f"out{suffix}").means) == len(scene.features)


def test_splats_for_a_viewer_are_the_same_file(interfaces: Interfaces) -> None:
    expected = interfaces.exported("viewer.splat", None, "splats")
    assert interfaces.of_lift("splats").content == expected
    assert interfaces.written_file("export", "-o", "viewer.splat") == expected
