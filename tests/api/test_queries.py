"""Questions over HTTP: words, examples and vectors, and by an answer's links its objects, pictures and splats."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from fastapi.testclient import TestClient
from starlette.requests import ClientDisconnect

from liftcore.text.table import TableEncoder
from liftcore.values.pack import write_pack
from liftcore.values.views import Regions
from service import query_worker as answers
from service.content import BINARY, BLOCK_BYTES, Draft
from service.errors import NoSpace
from service.models import AssetKind
from service.query_client import Frame
from service.store.files import DataDirectory
from tests.server import wait_for_end
from tests.tiny_scene import (
    CHANNELS,
    HEIGHT,
    WORDS,
    codebook,
    labels,
    text_table,
)

from .conftest import SceneAssets, parts_of, put
from .test_problems import assert_problem

LAMP = {"like": f"middle:26,{HEIGHT // 2}", "threshold": 0.5}


def array(content: bytes) -> np.ndarray:
    return np.load(io.BytesIO(content), allow_pickle=False)


def test_absent_word_is_compared_with_other_words_in_numbers(client: TestClient, lift: dict[str, Any]) -> None:
    words = (*WORDS, "boat", "bulb", "light", *(f"word {number}" for number in range(194)))
    rows = np.zeros((len(words), CHANNELS), np.float32)
    rows[:3], rows[3, 2:4], rows[4:6, 2] = (
        codebook(),
        (0.4, 0.9),
        1.0,
    )  # bulb and light are lamps; a boat hardly is one
    rows[4:6, 4:6] = 0.1 * np.eye(2)
    rows[6:, 4:] = np.random.default_rng(3).normal(size=(194, CHANNELS - 4))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    table = client.put("/assets/table", content=text_table(words=words, rows=rows)).json()["id"]
    parameters = {"lift": lift["id"], "table": table}
    for route in ("/query", "/query/objects"):
        absent = client.get(route, params=parameters | {"text": "boat"}).json()
        assert absent["present"] is False
        assert absent["comparison"] == {"nearer": 3, "limit": 1, "count": 200, "nearest": "lamp"}
        present = client.get(route, params=parameters | {"text": "apple"}).json()
        assert present["present"] is True and present["comparison"] is None
    for method in ("auto", "valley", "paper", "otsu", "stability", 0.5):
        answer = client.get("/query", params=parameters | {"text": "apple", "threshold": method}).json()
        assert answer["threshold"]["method"] == (method if isinstance(method, str) else "fixed")
    assert client.delete(f"/assets/{table}").status_code == 204


def test_words_of_a_pack_need_no_encoder_of_the_operator(
    client: TestClient, scene_assets: SceneAssets, tmp_path: Path
) -> None:
    words = TableEncoder("phrases", ["left thing", "right thing"], codebook()[[0, 2]])
    views = {name: Regions(view_labels, codebook()) for name, view_labels in labels().items()}
    write_pack(tmp_path / "pack", views, {"text_space": "prompts"}, table=words)
    pack = put(client, AssetKind.FEATURES, (tmp_path / "pack").read_bytes())
    job = wait_for_end(
        client, client.post("/lift", json=scene_assets.order() | {"features": [pack]}).headers["location"]
    )
    lift = client.get(job["links"]["lift"]).json()
    assert (lift["text_space"], lift["words"]) == ("prompts", ["left thing", "right thing"])
    for text in ("Left_thing", "right thing"):
        answer = client.get("/query", params={"lift": lift["id"], "text": text, "top": 1}).json()
        assert (answer["count"], answer["clear"], answer["encoder"]) == (20, True, "prompts")
        assert (answer["top"][0]["splat"] < 20) == (text == "Left_thing")
    problem = assert_problem(client.get("/query", params={"lift": lift["id"], "text": "apple"}))
    assert problem["status"] == 422 and "the lift's own words" in problem["detail"]
    assert client.delete(job["links"]["self"], params={"with_lift": True}).status_code == 204
    assert client.delete(f"/assets/{pack}").status_code == 204


# Pictures and their tags


def test_every_question_has_a_tag_of_its_own(client: TestClient, lift: dict[str, Any]) -> None:
    def tag(path: str = "/query/mask", **extra: Any) -> str:
        params = {"like": "middle:26,12", "lift": lift["id"]} | ({"view": "middle"} if "mask" in path else {}) | extra
        reply = client.get(path, params=params)
        second = client.get(path, params=params, headers={"If-None-Match": reply.headers["etag"]})
        assert (reply.status_code, second.status_code, second.content) == (200, 304, b"")
        return reply.headers["etag"]

    changes: list[dict[str, Any]] = [
        {}, {"like": "middle:25,12"}, {"unlike": "middle:6,12"}, {"keep": "largest"}, {"instances": 2},
        {"text": "lamp"}, {"path": "/query/splats", "what": "object"}, {"path": "/query/splats", "what": "scores"},
        {"path": "/query/scores"}, {"path": "/query/selection"},
    ]  # fmt: skip
    assert len({tag(**change) for change in changes}) == len(changes)


# Splats, and what is too large for the pipe


def drafts(client: TestClient) -> list[Path]:
    return list((parts_of(client).store.files.root / "tmp").iterdir())


def test_too_little_disk_is_said_before_anything_is_made(
    client: TestClient, lift: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(DataDirectory, "free_bytes", lambda files: 0)
    parameters = {**LAMP, "lift": lift["id"]}
    assert assert_problem(client.get("/query/splats", params=parameters))["type"] == "/problems/no-space"
    assert client.get("/query", params=parameters).status_code == 200


def test_large_array_is_sent_from_a_file(
    client: TestClient, lift: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    content = bytes(3 * BLOCK_BYTES + 7)

    def call(request: dict[str, Any], waiter: object) -> Frame:
        Path(request["draft"]).write_bytes(content)
        return Frame({})

    monkeypatch.setattr(parts_of(client).query_client, "call", call)
    for reply in (
        client.get("/query/scores", params=LAMP | {"lift": lift["id"]}),
        client.post("/query/scores", json={"text": ["lamp"], "lift": lift["id"]}),
        client.get(f"/lifts/{lift['id']}/colours"),
    ):
        assert reply.content == content and reply.headers["content-type"] == "application/x-npy"
        assert "content-disposition" not in reply.headers
    assert not drafts(client)


def test_disk_that_fills_up_meanwhile_is_no_fault_of_ours() -> None:
    with pytest.raises(NoSpace):
        answers.write_draft([b"x"], Path("/dev/full"))
    with pytest.raises(IsADirectoryError):
        answers.write_draft([b"x"], Path("/dev"))


@pytest.mark.parametrize("leaves", [False, True], ids=["reads", "leaves"])
def test_draft_is_sent_without_its_name_and_closed_however_that_ends(tmp_path: Path, leaves: bool) -> None:
    content = np.random.default_rng(0).bytes(3 * BLOCK_BYTES + 17)
    (tmp_path / "draft").write_bytes(content)
    reply = Draft(tmp_path / "draft", BINARY, filename="object.ply", headers={})
    (tmp_path / "draft").unlink()
    frames: list[bytes] = []

    async def send(message: Any) -> None:
        frames.append(message.get("body", b""))
        if leaves and len(frames) == 3:
            raise OSError("gone")

    async def receive() -> Any:
        await anyio.sleep_forever()

    with pytest.raises(ClientDisconnect) if leaves else contextlib.nullcontext():
        anyio.run(reply, {"type": "http", "asgi": {"spec_version": "2.4"}}, receive, send)
    assert reply.file.closed
    assert max(map(len, frames)) == BLOCK_BYTES
    assert leaves or b"".join(frames) == content


# What is refused


# Many words at once, and those of an uploaded table
