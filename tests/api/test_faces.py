"""A question has the same answer from Python, the command line and HTTP, field by field."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import liftcore as lc
from liftcore import cli, models
from service.store.owners import SERVICE
from tests.tiny_scene import HEIGHT, WORDS

from .conftest import parts_of

EXAMPLES = (
    "middle:6,12", f"middle:26,{HEIGHT // 2}", "splat:0", "splat:47", "region:left:0:1", "middle:box:3,4,10,20",
    "middle:stroke:26,5,26,12,27,19", "splat:60", "middle:box:9,9,3,3", "none",
)  # the last three are refused  # fmt: skip
FLAGS = {"negatives": "--negative"}


def values_of(name: str) -> st.SearchStrategy[Any]:
    """Values of a field of a question, right ones for most, by what its schema says that it takes."""
    field = lc.Query.model_json_schema()["properties"][name]
    if name in ("text", "negatives"):
        return st.lists(st.sampled_from((*WORDS, "zeppelin")), max_size=1, unique=True)
    if name in ("like", "unlike"):
        return st.lists(st.sampled_from(EXAMPLES), max_size=2, unique=True)
    if name == "sets":
        return st.lists(st.sampled_from(("object:0", "object:2", "object:9", "none")), max_size=2)
    if name == "threshold":
        return st.sampled_from(("auto", "otsu", "valley", "best")) | st.floats(-1, 1).map(lambda cut: round(cut, 3))
    if "enum" in field:
        return st.sampled_from(field["enum"])
    low = next(part["minimum"] for part in (field, *field.get("anyOf", ())) if "minimum" in part)
    return st.integers(low, low + 12)


@st.composite
def questions(draw: st.DrawFn) -> dict[str, Any]:
    """The fields of a question, of which some are left out."""
    field_names = draw(st.sets(st.sampled_from(lc.Query.deciding()), max_size=4)) | {
        draw(st.sampled_from(("text", "like")))
    }
    return {name: draw(values_of(name)) for name in sorted(field_names)} | {"top": draw(st.integers(1, 9))}


class Faces:
    """One lift, asked in every way."""

    def __init__(self, client: TestClient, lift: str, table: Path) -> None:
        store = parts_of(client).store
        job = store.jobs.get(SERVICE, lift)
        self.client, self.lift, self.table = client, lift, table
        self.path = store.lifts.get(SERVICE, lift).path
        self.splats, self.cameras, self.pack = (
            store.assets.get(SERVICE, asset).path for asset in (job.splats, job.cameras, job.features[0])
        )
        self.scene = lc.Scene(self.path, self.splats, self.cameras)
        self.scene.find_packs([self.pack])

    def python(self, fields: dict[str, Any]) -> dict[str, Any] | None:
        """The answer with its objects; None where the question is refused."""
        try:
            answer = self.scene.ask(lc.Query(**fields), encoder=f"table:{self.table}", places=True)
            objects = self.scene.objects(answer)
        except lc.SplatliftError:
            return None
        return answer.model_dump(mode="json") | objects.model_dump(mode="json")

    def http(self, method: str, query_fields: dict[str, Any]) -> dict[str, Any] | None:
        """The same of GET or POST."""
        answers: dict[str, Any] = {}
        for path in ("/query", "/query/objects"):
            fields = query_fields if path == "/query" or method == "POST" else {**query_fields, "top": None}
            parameters = {name: value for name, value in fields.items() if value is not None} | {"lift": self.lift}
            reply = (
                self.client.get(path, params=parameters)
                if method == "GET"
                else self.client.post(path, json=parameters)
            )
            assert reply.status_code in (200, 404, 422), reply.text
            if reply.status_code != 200:
                return None
            answers |= reply.json()
        fields = (*lc.Answer.model_fields, *lc.Answer.model_computed_fields)
        fields += (*lc.Objects.model_fields, *lc.Objects.model_computed_fields)
        return {name: answers[name] for name in fields}

    def command(self, fields: dict[str, Any]) -> dict[str, Any] | None:
        """The same of the command line; it takes feature packs where the lift remembers them."""
        words = [*self.places, "--objects"]
        words += [text for text in fields.get("text", ()) if text]
        for name, value in fields.items():
            flag = FLAGS.get(name, f"--{name.replace('_', '-')}")
            words += [part for item in (value if isinstance(value, list) else [value]) for part in (flag, item)]
            words = words[: -2 * len(value)] if name == "text" and value else words
        return self.run_command("query", *words).get("answer")

    @property
    def places(self) -> list[Path | str]:
        """The lift and its files, as commands take them."""
        return [self.path, "--splats", self.splats, "--cameras", self.cameras]

    def run_command(self, command: str, *words: object) -> dict[str, Any]:
        """Return the JSON that a command prints; empty if the command fails."""
        output = io.StringIO()
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(io.StringIO()):
            status = cli.main([command, *map(str, words), "--table", str(self.table), "--json"])
        assert status in (0, cli.BAD_INPUT)
        return json.loads(output.getvalue()) if status == 0 else {}


@pytest.fixture(scope="module")
def faces(client: TestClient, lift: dict[str, Any], table: Path) -> Faces:
    return Faces(client, lift["id"], table)


def test_words_and_things_have_the_same_answers(faces: Faces, table: Path, tmp_path: Path) -> None:
    lift_copy = tmp_path / "scene.lift"  # the command for objects looks for the splats there
    shutil.copy(faces.path, lift_copy)
    shutil.copy(faces.splats, tmp_path / lc.load_lift(lift_copy).metadata.splats.path)
    encoder = faces.scene.encoder(f"table:{table}")
    expected = {
        "segment": faces.scene.segment(encoder=encoder).summary,
        "what": models.BestWords(example="splat:0", words=faces.scene.nearest_words("splat:0", encoder=encoder)),
        "objects": faces.scene.catalogue(faces.scene.words(encoder), encoder=encoder).summary(features=True),
    }
    table_id = faces.client.put("/assets/table", content=table.read_bytes()).json()["id"]
    fields = {"lift": faces.lift, "table": table_id}
    answers = {
        "segment": faces.client.post("/query/segment", json=fields).json(),
        "what": faces.client.post("/query/what", json=fields | {"example": "splat:0"}).json(),
        "objects": faces.client.get(
            f"/lifts/{faces.lift}/objects", params={"table": table_id, "features": True}
        ).json(),
    }
    for item in answers["objects"]["objects"]:
        del item["hidden"]  # which the service alone knows
    output = {
        "segment": faces.run_command("segment", *faces.places)["answer"],
        "what": faces.run_command("segment", *faces.places, "--example", "splat:0")["examples"][0],
        "objects": faces.run_command("objects", lift_copy, "--features")["answer"],
    }
    for name, answer in expected.items():
        document = answer.model_dump(mode="json")
        assert {field: answers[name][field] for field in document} == document == output[name]


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(fields=questions())
def test_every_face_gives_the_same_answer(faces: Faces, fields: dict[str, Any]) -> None:
    expected = faces.python(fields)
    assert faces.http("GET", fields) == expected
    assert faces.http("POST", fields) == expected
    if not any(example.startswith("region:") for name in ("like", "unlike") for example in fields.get(name, ())):
        assert faces.command(fields) == expected
