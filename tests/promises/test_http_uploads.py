"""Uploads over HTTP: one asset for the same bytes, whole or absent, and downloads in parts."""

from __future__ import annotations

import hashlib
import json
import socket
from typing import Any

import httpx
import numpy as np
import pytest

from tests.server import Server, until
from tests.tiny_scene import TinyScene, colmap_zip, labels, masks, ply, splat_rows, text_table

from .over_http import INPUTS, NO_ASSET, assert_problem, mutated, photos_zip, upload

SCENE = TinyScene(
    ply(splat_rows()[::-1]), colmap_zip(), masks({}), text_table(words=("fig", "mug", "pen"))
)  # of other bytes than the scene of the session
FILES: dict[str, tuple[bytes, str, Any]] = {
    "splats": (SCENE.splats, "splats", 60),
    "cameras": (SCENE.cameras, "views", 3),
    "masks": (masks({"left": labels()["left"][0]}), "names", ["left"]),
    "table": (SCENE.table, "words", ["fig", "mug", "pen"]),
    "photos": (photos_zip(), "photos", 1),
}


def delete(client: httpx.Client, *assets: str) -> None:
    for asset in assets:
        assert client.delete(f"/assets/{asset}").status_code == 204


@pytest.mark.parametrize("kind", FILES)
def test_file_of_each_kind_is_stored_under_its_digest(client: httpx.Client, kind: str) -> None:
    content, name, count = FILES[kind]
    reply = client.put(f"/assets/{kind}", content=content)
    asset = reply.json()
    assert reply.status_code == 201, reply.text
    assert reply.headers["location"] == f"/assets/{asset['id']}" == asset["links"]["self"]
    assert asset["id"] == f"sha256:{hashlib.sha256(content).hexdigest()}"
    assert (asset["kind"], asset["bytes"], asset["counts"][name]) == (kind, len(content), count)
    assert isinstance(asset["warnings"], list) and asset["created"] > 0
    description = client.get(reply.headers["location"]).json()
    assert {**description, "counts": 0} == {**asset, "counts": 0}
    assert description["id"] in {entry["id"] for entry in client.get("/assets").json()["assets"]}
    assert client.get(asset["links"]["content"]).content == content
    delete(client, asset["id"])
    for path in (reply.headers["location"], asset["links"]["content"]):
        assert_problem(client.get(path), 404)
    assert_problem(client.delete(reply.headers["location"]), 404)


def test_same_bytes_are_the_same_asset_however_they_come(
    client: httpx.Client, order: dict[str, Any], tiny: TinyScene
) -> None:
    digest, half = hashlib.sha256(tiny.splats).hexdigest(), len(tiny.splats) // 2
    pieces = (part for part in (tiny.splats[:half], tiny.splats[half:]))  # of unknown length
    for content in (tiny.splats, pieces):
        reply = client.put("/assets/splats", content=content)
        assert (reply.status_code, reply.json()["id"]) == (200, order["splats"]) == (200, f"sha256:{digest}")
    assert [asset["id"] for asset in client.get("/assets").json()["assets"]].count(order["splats"]) == 1


def test_counts_say_what_a_lift_needs(client: httpx.Client, order: dict[str, Any]) -> None:
    splats, features = (client.get(f"/assets/{asset}").json() for asset in (order["splats"], order["features"][0]))
    assert (splats["counts"]["splats"], splats["counts"]["kernel"]) == (60, "3dgs")
    counts = features["counts"]
    assert (counts["views"], counts["channels"], counts["text_space"], counts["region_maps"]) == (3, 8, "tiny", 3)


BAD_FILES: dict[str, tuple[str, bytes]] = {
    "no splats": ("splats", b"no splats at all"),
    "JSON that breaks off": ("cameras", b'{"w": 32, "frames": ['),
    "a header beyond the file": ("features", (1 << 62).to_bytes(8, "little") + b"{}"),
    "a table without words": ("table", text_table().replace(b"words", b"wordz")),
    "a zip without photos": ("photos", colmap_zip()),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file_is_refused_with_reasons_and_leaves_nothing(client: httpx.Client, server: Server, name: str) -> None:
    kind, content = BAD_FILES[name]
    before, stored = client.get("/assets").json(), stored_files(server)
    problem = assert_problem(client.put(f"/assets/{kind}", content=content), 422)
    assert problem["argument"] and problem["expected"] and problem["got"]
    assert str(server.data) not in json.dumps(problem)
    assert client.get("/assets").json() == before
    assert_problem(client.get(f"/assets/sha256:{hashlib.sha256(content).hexdigest()}"), 404)
    until(lambda: stored_files(server) == stored, seconds=120)


@pytest.mark.parametrize("kind", [*INPUTS, "table"])
def test_changed_upload_is_stored_or_refused_and_never_a_fault(
    client: httpx.Client, tiny: TinyScene, kind: str
) -> None:
    for seed in range(15):
        reply = client.put(f"/assets/{kind}", content=mutated(getattr(tiny, kind), seed))
        if reply.status_code == 201:
            delete(client, reply.json()["id"])
        elif reply.status_code != 200:
            assert_problem(reply, 422)


def stored_files(server: Server) -> int:
    """The number of files that might be of an upload."""
    return sum(path.is_file() and "sqlite" not in path.name for path in server.data.rglob("*"))


def test_file_of_another_kind_is_told_its_route(client: httpx.Client, tiny: TinyScene) -> None:
    problem = assert_problem(client.put("/assets/splats", content=tiny.cameras), 422)
    assert "cameras" in problem["got"] and "cameras" in problem["hint"]
    for kind in ("camera", "nothing", "..%2f..%2fetc"):
        assert_problem(client.put(f"/assets/{kind}", content=tiny.cameras))


def test_body_that_is_too_large_is_413_and_leaves_nothing(client: httpx.Client, server: Server) -> None:
    rows = np.repeat(splat_rows(), 100, axis=0)
    content, stored = ply(rows), stored_files(server)
    assert len(content) > 200_000
    for body in (content, (part for part in (content[:1000], content[1000:]))):
        try:
            assert_problem(client.put("/assets/splats", content=body), 413)
        except httpx.TransportError:  # it closes the connection before all was sent
            assert server.is_alive()
    assert_problem(client.post("/lift", content=b" " * (3 << 20), headers={"Content-Type": "application/json"}), 413)
    assert_problem(client.get(f"/assets/sha256:{hashlib.sha256(content).hexdigest()}"), 404)
    until(lambda: stored_files(server) == stored, seconds=120)


@pytest.mark.parametrize("length", ["Content-Length: 100000", "Transfer-Encoding: chunked"])
def test_upload_that_is_cut_off_leaves_nothing(client: httpx.Client, server: Server, length: str) -> None:
    before, stored = client.get("/assets").json(), stored_files(server)
    url = client.base_url
    with socket.create_connection((url.host, url.port or 80)) as connection:
        head = f"PUT /assets/splats HTTP/1.1\r\nHost: 127.0.0.1\r\n{length}\r\n\r\n"
        connection.sendall(head.encode() + b"10\r\n" * ("chunked" in length) + ply(splat_rows())[:2000])
    until(lambda: stored_files(server) == stored, seconds=120)
    assert client.get("/assets").json() == before
    assert client.get("/healthz").status_code == 200


def test_part_of_a_file_is_the_bytes_of_its_range(
    client: httpx.Client, order: dict[str, Any], tiny: TinyScene
) -> None:
    path, header = f"/assets/{order['splats']}/content", "bytes=3700-99999"
    reply = client.get(path, headers={"Range": header})
    assert (reply.status_code, reply.content) == (206, tiny.splats[3700:])
    assert reply.headers["content-range"] == f"bytes 3700-{len(tiny.splats) - 1}/{len(tiny.splats)}"
    for other in ({}, {"Range": header, "If-Range": '"another"'}):
        reply = client.get(path, headers=other)
        assert (reply.status_code, reply.content, reply.headers["accept-ranges"]) == (200, tiny.splats, "bytes")


def test_part_of_a_file_is_no_asset(client: httpx.Client, tiny: TinyScene) -> None:
    part, before = tiny.splats[:-28], client.get("/assets").json()
    header = {"Content-Range": f"bytes 0-{len(part) - 1}/{len(tiny.splats)}"}
    problem = assert_problem(client.put("/assets/splats", content=part, headers=header), 400)
    assert "in one request" in str(problem)
    assert client.get("/assets").json() == before


def test_asset_that_a_lift_needs_stays(client: httpx.Client, lift: dict[str, Any]) -> None:
    for asset in (lift["splats"], lift["cameras"], *lift["features"]):
        problem = assert_problem(client.delete(f"/assets/{asset}"), 409)
        assert lift["id"] in json.dumps(problem)
        assert client.get(f"/assets/{asset}/content").status_code == 200


def test_list_of_assets_comes_in_pages(client: httpx.Client, order: dict[str, Any]) -> None:
    del order
    own_items = upload(client, "table", SCENE.table)
    all_items = client.get("/assets").json()
    entries, parameters = [], {"limit": 2}
    while True:
        page = client.get("/assets", params=parameters).json()
        assert 1 <= len(page["assets"]) <= 2
        entries += page["assets"]
        if page["next"] is None:
            break
        parameters["cursor"] = page["next"]
    assert entries == all_items["assets"] and entries[0]["id"] == own_items  # newest first
    delete(client, own_items)
    assert_problem(client.get(f"/assets/{NO_ASSET}"), 404)
