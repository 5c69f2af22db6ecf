"""What good uploads promise: one asset for the same bytes, however they come, and downloads of them."""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi import Request
from fastapi.testclient import TestClient

from liftcore.errors import NotFound
from service.content import file_answer

from .conftest import Uploaded
from .tiny_scene import TinyScene, ply, splat_rows


def test_same_bytes_are_the_same_asset(client: TestClient, uploaded: Uploaded, scene: TinyScene) -> None:
    again = client.put("/assets/splats", content=scene.splats)
    assert again.status_code == 200 and again.json()["id"] == uploaded.splats
    assert uploaded.splats == f"sha256:{hashlib.sha256(scene.splats).hexdigest()}"


def test_gzip_gives_the_asset_of_the_content(client: TestClient, uploaded: Uploaded, scene: TinyScene) -> None:
    half = len(scene.splats) // 2
    parts = gzip.compress(scene.splats[:half]) + gzip.compress(scene.splats[half:])
    digest = uploaded.splats.removeprefix("sha256:")
    reply = client.put(
        "/assets/splats",
        content=parts,
        headers={"Content-Encoding": "gzip"},
        params={"sha256": digest.upper()},
    )
    assert reply.status_code == 200 and reply.json()["id"] == uploaded.splats


def test_body_may_come_in_pieces_of_unknown_number(client: TestClient, uploaded: Uploaded, scene: TinyScene) -> None:
    def pieces() -> Iterator[bytes]:
        for start in range(0, len(scene.splats), 100):
            yield scene.splats[start : start + 100]

    reply = client.put("/assets/splats", content=pieces())
    assert reply.status_code == 200 and reply.json()["id"] == uploaded.splats


def test_content_is_what_was_uploaded(client: TestClient, uploaded: Uploaded, scene: TinyScene) -> None:
    reply = client.get(f"/assets/{uploaded.splats}/content")
    assert reply.content == scene.splats
    digest = uploaded.splats.removeprefix("sha256:")
    assert reply.headers["etag"] == f'"{digest}"'
    assert reply.headers["accept-ranges"] == "bytes"


@pytest.mark.parametrize(
    ("header", "status", "part"),
    [
        ("bytes=0-3", 206, slice(0, 4)),
        ("bytes=10-", 206, slice(10, None)),
        ("bytes=-7", 206, slice(-7, None)),
        ("bytes=5-2", 200, slice(None)),  # malformed ranges are ignored, as RFC 9110 says
        ("bytes=nonsense", 200, slice(None)),
        ("lines=0-3", 200, slice(None)),
        ("bytes=0-1,4-5", 200, slice(None)),  # several ranges may be answered with the whole
        ("bytes=0-" + "9" * 5000, 200, slice(None)),
    ],
)
def test_ranges(
    client: TestClient, uploaded: Uploaded, scene: TinyScene, header: str, status: int, part: slice
) -> None:
    reply = client.get(f"/assets/{uploaded.splats}/content", headers={"Range": header})
    assert (reply.status_code, reply.content) == (status, scene.splats[part])


@pytest.mark.parametrize("header", ["bytes=999999-", "bytes=-0", "bytes=" + "9" * 5000 + "-"])
def test_range_beyond_the_end_is_416(client: TestClient, uploaded: Uploaded, scene: TinyScene, header: str) -> None:
    reply = client.get(f"/assets/{uploaded.splats}/content", headers={"Range": header})
    assert (reply.status_code, reply.json()["type"]) == (416, "/problems/range-not-satisfiable")
    assert reply.headers["content-range"] == f"bytes */{len(scene.splats)}"


def test_range_of_another_version_gives_the_whole(client: TestClient, uploaded: Uploaded, scene: TinyScene) -> None:
    headers = {"Range": "bytes=0-3", "If-Range": '"another"'}
    reply = client.get(f"/assets/{uploaded.splats}/content", headers=headers)
    assert (reply.status_code, reply.content) == (200, scene.splats)


def test_known_content_is_304(client: TestClient, uploaded: Uploaded) -> None:
    path = f"/assets/{uploaded.splats}/content"
    tag = client.get(path).headers["etag"]
    for header in (tag, f'"other", {tag}', f"W/{tag}", "*"):
        reply = client.get(path, headers={"If-None-Match": header})
        assert (reply.status_code, reply.content) == (304, b"")


def test_asset_in_use_stays(client: TestClient, uploaded: Uploaded, lift: dict[str, object]) -> None:
    for asset in (uploaded.splats, uploaded.cameras, uploaded.features):
        reply = client.delete(f"/assets/{asset}")
        assert (reply.status_code, reply.json()["type"]) == (409, "/problems/in-use")
        assert str(lift["id"]) in reply.json()["hint"]
        assert client.get(f"/assets/{asset}/content").status_code == 200


def test_deleted_asset_is_gone_and_may_come_back(client: TestClient) -> None:
    rows = splat_rows()
    rows[:, 1] += 0.25
    content = ply(rows)
    first = client.put("/assets/splats", content=content)
    assert first.status_code == 201, first.text
    path = first.headers["location"]
    assert client.delete(path).status_code == 204
    assert client.get(path).status_code == 404
    assert client.delete(path).status_code == 404
    assert client.put("/assets/splats", content=content).status_code == 201
    assert client.delete(path).status_code == 204


def test_content_that_goes_while_it_is_asked_for_is_404(tmp_path: Path) -> None:
    request = Request({"type": "http", "headers": []})
    with pytest.raises(NotFound, match="deleted"):
        file_answer(request, tmp_path / "gone", sha256="0" * 64, filename="x")
