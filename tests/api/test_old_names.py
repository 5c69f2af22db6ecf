"""Names of fields before they were renamed: parameters and bodies are still read by them, and replies have both."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from safetensors import safe_open
from safetensors.numpy import save

from liftcore import LiftSettings
from liftcore.values.lift_file import OLD_DIAGNOSTICS
from service import models
from service.routes.lifts import shape_tradeoff
from service.store.lifts import FinishedTradeoff
from service.store.owners import SERVICE
from service.store.store import Store
from tests.crash.conftest import order
from tests.server import wait_for_end
from tests.tiny_scene import TinyScene

from .test_jobs import Quick, quick
from .test_problems import assert_problem

__all__ = ["quick"]  # a fixture


@pytest.mark.parametrize(
    ("path", "fields", "old", "new", "values"),
    [
        ("/query/scores", {"like": ["splat:1"]}, "weigh", "weight_by", ("total_weight", "confidence")),
        ("/render", {"view": "middle"}, "what", "channel", ("pca", "rgb")),
    ],
)
def test_old_names_of_fields_are_read_and_contradictions_are_refused(
    client: TestClient, lift: dict[str, Any], path: str, fields: dict[str, Any], old: str, new: str, values: Any
) -> None:
    def reply(method: str, **names: Any) -> Any:
        request = fields | names | {"lift": lift["id"]}
        return client.get(path, params=request) if method == "GET" else client.post(path, json=request)

    value, other = values
    for method in ("GET", "POST"):
        expected = reply(method, **{new: value})
        assert expected.status_code == 200
        assert reply(method, **{old: value}).content == expected.content
        assert reply(method, **{old: value, new: value}).content == expected.content
        for names in ({old: other, new: value}, {old: value, new: other}):
            problem = assert_problem(reply(method, **names))
            assert (problem["status"], problem["argument"]) == (422, new) and old in problem["expected"]
        wrong = assert_problem(reply(method, **{old: "nothing"}))
        assert (wrong["status"], wrong["argument"]) == (422, new)
    unknown = assert_problem(reply("GET", weight="evidence"))
    names = unknown["expected"].split(", ")
    assert new in names and old not in names


def test_old_values_of_fields_are_read_as_the_new_ones(client: TestClient, lift: dict[str, Any]) -> None:
    query = {"lift": lift["id"], "like": ["splat:1"]}
    values = ({"weight_by": "evidence"}, {"weigh": "evidence", "weight_by": "total_weight"})
    expected = client.get("/query/scores", params=query | {"weight_by": "total_weight"})
    assert expected.status_code == 200
    for names in values:
        assert client.get("/query/scores", params=query | names).content == expected.content
        assert client.post("/query/scores", json=query | names).content == expected.content


def test_edits_are_read_by_their_old_names_and_listed_by_both(client: TestClient, lift: dict[str, Any]) -> None:
    route = f"/lifts/{lift['id']}/selections"
    edit = {"how": "set", "query": {"like": ["splat:1"], "weigh": "evidence", "keep": "largest"}}
    selection = client.post(route, json={"name": "old", "edit": edit}).json()
    edits = selection["links"]["edits"]
    assert client.post(edits, json={"how": "grow", "operation": "grow"}).status_code == 200
    problem = assert_problem(client.post(edits, json={"how": "grow", "operation": "shrink"}))
    assert (problem["status"], problem["argument"]) == (422, "operation")
    history = client.get(selection["links"]["self"]).json()["history"]
    assert [(step["edit"]["operation"], step["edit"]["how"]) for step in history] == [("set",) * 2, ("grow",) * 2]
    stored = {"how": "set", "query": {"like": ["splat:1"], "weigh": "evidence"}}
    step = models.SelectionStep(number=1, edit=stored, count=1).edit
    assert (step["operation"], step["query"]["weight_by"], step["query"]["weigh"]) == ("set",) + ("total_weight",) * 2
    client.delete(selection["links"]["self"])


def test_replies_have_old_names_beside_the_new_ones(client: TestClient, lift: dict[str, Any], table: Any) -> None:
    query = {"lift": lift["id"], "text": "lamp"}
    table_id = client.put("/assets/table", content=table.read_bytes()).json()["id"]
    replies = (
        (client.get("/query", params=query), ("reason", "why")),
        (client.get("/query/objects", params=query), ("reason", "why"), ("unassigned_splats", "strays")),
        (client.get("/query/words", params={"lift": lift["id"]}), ("scene_words", "here")),
        (client.get("/query/words", params={"lift": lift["id"]}), ("open_vocabulary", "any_text")),
        (
            client.post("/query/segment", json={"lift": lift["id"], "table": table_id}),
            ("named_words", "found"), ("word_count", "words"),
        ),
    )  # fmt: skip
    for reply, *pairs in replies:
        document = reply.json()
        for new, old in pairs:
            assert document[new] == document[old], reply.request.url


def test_settings_are_read_by_old_names_and_returned_by_both(quick: Quick) -> None:
    with quick("answer") as (client, body):
        orders = {"/lift": {"speed": "draft", "certificate_rays": 7}, "/tradeoff": {"certificate_rays": 7}}
        for path, settings in orders.items():
            order = body | {"settings": settings} | ({"budget_s": 60} if path == "/tradeoff" else {})
            job = wait_for_end(client, client.post(path, json=order).headers["location"])
            assert {name: job["settings"][name] for name in settings} == settings
            for old in settings:
                new = LiftSettings.old_names[old]
                assert job["settings"][new] == job["settings"][old]
                wrong = order | {"settings": settings | {new: LiftSettings.model_fields[new].default}}
                problem = assert_problem(client.post(path, json=wrong))
                assert (problem["status"], problem["argument"]) == (422, new)
                assert f"{old} is the old name of {new}" in problem["expected"]


def test_stored_tradeoffs_have_both_names_whichever_they_were_stored_by(store: Store) -> None:
    for over_budget, invalid_runs, stride, share in (
        ("skipped", "refused", "certificate_rays", "seen_share"),
        ("over_budget", "invalid_runs", "diagnostic_rays", "feature_share"),
    ):
        job, _ = store.jobs.submit(SERVICE, replace(order(store), kind=models.JobKind.TRADEOFF))
        runs = [{"name": "exact", "options": {}, "settings": {stride: 7}, share: 0.5}]
        names = {over_budget: ["mean"], invalid_runs: ["argmax"], "runs": runs}
        attempt = store.jobs.claim()
        assert attempt is not None and attempt.id == job
        document = names | {"choice": {}, "views": {}, "budget_s": 60, "seconds": 1}
        assert store.tradeoffs.finish(job, attempt.attempt, FinishedTradeoff(document, "a table", b"a chart"))
        reply = shape_tradeoff(store.tradeoffs.get(SERVICE, job)).model_dump(mode="json")
        assert reply["over_budget"] == reply["skipped"] == ["mean"]
        assert reply["invalid_runs"] == reply["refused"] == ["argmax"]
        assert reply["runs"][0]["feature_share"] == reply["runs"][0]["seen_share"] == 0.5
        assert reply["runs"][0]["settings"] == {"diagnostic_rays": 7, "certificate_rays": 7}


@pytest.mark.parametrize("old", OLD_DIAGNOSTICS)
def test_diagnostics_of_a_lift_have_old_names_beside_the_new_ones(
    client: TestClient, lift: dict[str, Any], old: str, tmp_path: Path, start: Any, scene: TinyScene
) -> None:
    content = client.get(f"/lifts/{lift['id']}/features").content
    (tmp_path / "lift").write_bytes(content)
    with safe_open(tmp_path / "lift", "np") as file:
        metadata = json.loads(file.metadata()["splatlift"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    with start() as other:  # no other test sees these lifts
        for kind in ("splats", "cameras"):
            assert other.put(f"/assets/{kind}", content=getattr(scene, kind)).status_code == 201
        for name in (old, OLD_DIAGNOSTICS[old]):
            diagnostics = {name: 0.25}
            text = json.dumps(metadata | {"diagnostics": diagnostics})
            reply = other.post("/lifts", content=save(tensors, {"splatlift": text}))
            assert reply.status_code == 201
            document = other.get(reply.json()["links"]["self"]).json()
            assert document["diagnostics"] == document["certificate"] == {OLD_DIAGNOSTICS[old]: 0.25, old: 0.25}
        text = json.dumps(metadata | {"diagnostics": {old: 0.25, OLD_DIAGNOSTICS[old]: 0.5}})
        problem = assert_problem(other.post("/lifts", content=save(tensors, {"splatlift": text})))
        assert problem["status"] == 422 and old in problem["expected"]


def test_a_zip_of_things_is_one_of_objects(client: TestClient, lift: dict[str, Any]) -> None:
    old, new = (client.post("/query/export", json={"lift": lift["id"], "of": of}) for of in ("things", "objects"))
    assert (old.status_code, old.content) == (new.status_code, new.content)
    assert old.headers.get("content-disposition") == new.headers.get("content-disposition")
    assert assert_problem(client.post("/query/export", json={"lift": lift["id"], "of": "odd"}))["status"] == 422


def test_old_names_are_deprecated_in_the_description_of_the_routes(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    parameters = {item["name"]: item for item in document["paths"]["/query"]["get"]["parameters"]}
    assert parameters["weigh"]["deprecated"] and "deprecated" not in parameters["weight_by"]
    schemas = document["components"]["schemas"]
    expected = {
        "Question": {"weigh"}, "RenderRequest": {"what"}, "EditRequest": {"how"}, "QueryAnswer": {"why"},
        "ObjectsAnswer": {"why", "strays"}, "WordsAnswer": {"any_text", "here"}, "SegmentAnswer": {"words", "found"},
    }  # fmt: skip
    for name, fields in expected.items():
        properties = schemas[name]["properties"]
        assert {field for field, schema in properties.items() if schema.get("deprecated")} == fields, name
