"""Answers as splats over HTTP: the object and the coloured scene, made as drafts that nobody keeps."""

from __future__ import annotations

import contextlib
import io
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from fastapi.testclient import TestClient
from plyfile import PlyData
from starlette.requests import ClientDisconnect

from liftcore.errors import SplatliftError
from service.content import BINARY, BLOCK_BYTES, Draft
from service.errors import NoSpace
from service.queries import answers
from service.queries.client import Frame

from .conftest import parts_of
from .following import ended
from .test_problems import assert_problem
from .tiny_scene import HEIGHT, SPLATS_A_CLUSTER, TinyScene, codebook, ply, splat_rows

LAMP = {"like": f"middle:26,{HEIGHT // 2}", "threshold": 0.5}


def drafts(client: TestClient) -> list[Path]:
    return list((parts_of(client).store.files.root / "tmp").iterdir())


def rows_of(content: bytes) -> np.ndarray:
    return PlyData.read(io.BytesIO(content))["vertex"].data


def test_the_object_is_the_rows_that_were_found_to_the_byte(client: TestClient, lift: dict[str, Any]) -> None:
    answer = client.get("/query", params={**LAMP, "lift": lift["id"]}).json()
    scores = np.load(io.BytesIO(client.get(answer["links"]["scores"]).content), allow_pickle=False)
    reply = client.get(answer["links"]["object"])
    assert reply.status_code == 200, reply.text
    assert reply.content == ply(splat_rows()[scores >= 0.5])
    assert 0.8 * SPLATS_A_CLUSTER <= answer["count"] == len(rows_of(reply.content)) <= 1.2 * SPLATS_A_CLUSTER
    assert reply.headers["content-type"] == "application/octet-stream"
    assert reply.headers["content-disposition"] == f'attachment; filename="object-{lift["id"]}.ply"'
    assert int(reply.headers["content-length"]) == len(reply.content)
    assert client.get("/query/splats", params={**LAMP, "lift": lift["id"]}).content == reply.content
    assert not drafts(client)


def test_the_scene_in_the_colours_of_its_scores_is_the_same_but_for_colours(
    client: TestClient, lift: dict[str, Any], scene: TinyScene
) -> None:
    answer = client.get("/query", params={**LAMP, "lift": lift["id"]}).json()
    reply = client.get(answer["links"]["coloured"])
    before, after = rows_of(scene.splats), rows_of(reply.content)
    changed = {name for name in before.dtype.names or () if before[name].tobytes() != after[name].tobytes()}
    assert changed == {"f_dc_0", "f_dc_1", "f_dc_2"}
    assert after["f_dc_1"][-SPLATS_A_CLUSTER:].min() > after["f_dc_1"][:-SPLATS_A_CLUSTER].max()
    assert f'filename="scores-{lift["id"]}.ply"' in reply.headers["content-disposition"]


def test_an_object_is_uploaded_and_lifted_again(
    start: Callable[..., Any], client: TestClient, lift: dict[str, Any], scene: TinyScene
) -> None:
    found = client.get("/query/splats", params={**LAMP, "lift": lift["id"]}).content
    with start() as other:
        contents = {"splats": found, "cameras": scene.cameras, "features": scene.features}
        ids = {kind: other.put(f"/assets/{kind}", content=content).json()["id"] for kind, content in contents.items()}
        order = {"splats": ids["splats"], "cameras": ids["cameras"], "features": [ids["features"]]}
        job = ended(other, other.post("/lift", json=order).headers["location"])
        assert job["state"] == "succeeded", job


def test_splats_have_tags_of_their_own_and_are_not_made_for_who_has_them(
    client: TestClient, lift: dict[str, Any]
) -> None:
    params = {**LAMP, "lift": lift["id"]}
    tags = [
        client.get("/query/splats", params=params | {"what": what}).headers["etag"] for what in ("object", "scores")
    ]
    assert len({*tags, client.get("/query/scores", params=params).headers["etag"]}) == 3
    again = client.get("/query/splats", params=params, headers={"If-None-Match": tags[0]})
    assert again.status_code == 304 and again.content == b""
    assert client.get("/query/splats", params=params).headers["etag"] == tags[0]  # whatever its draft was called


def test_splats_of_a_vector_are_asked_by_post(client: TestClient, lift: dict[str, Any]) -> None:
    body = {"like": [codebook()[2].tolist()], "threshold": 0.5, "lift": lift["id"]}
    links = client.post("/query", json=body).json()["links"]
    assert links["object"] == "/query/splats?what=object"
    found, coloured = (client.post(links[name], json=body) for name in ("object", "coloured"))
    assert found.content == client.get("/query/splats", params={**LAMP, "lift": lift["id"]}).content
    assert len(rows_of(coloured.content)) == 3 * SPLATS_A_CLUSTER
    assert assert_problem(client.post("/query/splats?what=mesh", json=body))["argument"] == "what"


def test_nothing_found_is_a_problem_that_says_what_to_try(client: TestClient, lift: dict[str, Any]) -> None:
    params = {**LAMP, "negatives": "book", "threshold": 1, "lift": lift["id"]}
    assert "object" not in client.get("/query", params=params).json()["links"]
    problem = assert_problem(client.get("/query/splats", params=params))
    assert (problem["status"], problem["type"]) == (422, "/problems/invalid-query")
    assert "nothing stands out" in problem["got"] and "threshold" in problem["hint"]
    assert len(rows_of(client.get("/query/splats", params=params | {"what": "scores"}).content)) == 60
    assert not drafts(client)


def test_too_little_disk_is_said_before_anything_is_made(start: Callable[..., Any], data: Path) -> None:
    with start("copy") as client:
        target = parts_of(client).store.files.root
    shutil.rmtree(target)
    shutil.copytree(data, target, ignore=shutil.ignore_patterns("lock", "*-shm", "tmp"))
    with start("copy", disk_floor_bytes=1 << 60) as client:
        assert assert_problem(client.get("/query/splats", params=LAMP))["type"] == "/problems/no-space"
        assert client.get("/query", params=LAMP).status_code == 200


def test_large_array_is_sent_from_a_file(
    client: TestClient, lift: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    content = bytes(3 * BLOCK_BYTES + 7)

    def call(wanted: dict[str, Any], asker: object) -> Frame:
        Path(wanted["draft"]).write_bytes(content)
        return Frame({})

    monkeypatch.setattr(parts_of(client).queries, "call", call)
    for reply in (
        client.get("/query/scores", params=LAMP | {"lift": lift["id"]}),
        client.post("/query/scores", json={"text": ["lamp"], "lift": lift["id"]}),
        client.get(f"/lifts/{lift['id']}/colours"),
    ):
        assert reply.content == content and reply.headers["content-type"] == "application/x-npy"
        assert "content-disposition" not in reply.headers
    assert not drafts(client)


def test_a_disk_that_fills_up_meanwhile_is_no_fault_of_ours() -> None:
    with pytest.raises(NoSpace) as refused:
        answers.write_draft([b"x"], Path("/dev/full"))
    assert isinstance(refused.value, SplatliftError)
    with pytest.raises(IsADirectoryError):
        answers.write_draft([b"x"], Path("/dev"))


@pytest.mark.parametrize("leaves", [False, True], ids=["reads", "leaves"])
def test_a_draft_is_sent_without_its_name_and_closed_however_that_ends(tmp_path: Path, leaves: bool) -> None:
    content = np.random.default_rng(0).bytes(3 * BLOCK_BYTES + 17)
    (tmp_path / "draft").write_bytes(content)
    reply = Draft(tmp_path / "draft", BINARY, filename="object.ply", headers={})
    (tmp_path / "draft").unlink()
    sent: list[bytes] = []

    async def send(message: Any) -> None:
        sent.append(message.get("body", b""))
        if leaves and len(sent) == 3:
            raise OSError("gone")

    async def receive() -> Any:
        await anyio.sleep_forever()

    with pytest.raises(ClientDisconnect) if leaves else contextlib.nullcontext():
        anyio.run(reply, {"type": "http", "asgi": {"spec_version": "2.4"}}, receive, send)
    assert reply.file.closed
    assert max(map(len, sent)) == BLOCK_BYTES
    assert leaves or b"".join(sent) == content
