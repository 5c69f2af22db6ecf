"""Nobody waits for another's disk: no file and no database is touched on the event loop, and answers have a bound."""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest
from fastapi.testclient import TestClient

from service import middleware
from service.errors import NoSpace
from service.models import MAX_SETTINGS, AssetKind
from service.observe import SAME_A_MINUTE, Sparing
from service.queries.client import Frame
from service.store.assets import SHOWN_CHARACTERS
from service.store.database import Database
from service.store.files import DataDirectory
from service.store.owners import SERVICE
from tests.crash.server import NoQueries

from .conftest import Uploaded, app_of, parts_of, put
from .guarded import address, every_route, guarded
from .test_problems import assert_problem
from .tiny_scene import TinyScene, cameras_document

Start = Callable[..., Any]
WATCHED: list[Callable[[str, tuple[Any, ...]], None]] = []  # an audit hook stays for good, so it asks here
TOUCHES = {
    "open", "sqlite3.connect", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.scandir", "os.listdir",
    "shutil.rmtree", "subprocess.Popen", "glob.glob",
}  # fmt: skip
sys.addaudithook(lambda event, given: [watch(event, given) for watch in WATCHED] and None)


@contextmanager
def touches_on_the_loop(client: TestClient, patch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """What the thread of the event loop does to our files and the database."""
    assert client.portal is not None
    loop, root = client.portal.call(threading.get_ident), str(parts_of(client).store.files.root)
    ours = (root, str(Path(__file__).parents[2] / "service" / "web"))
    seen: list[str] = []

    def note(what: str) -> None:
        if threading.get_ident() == loop:
            seen.append(what)

    def heard(event: str, given: tuple[Any, ...]) -> None:
        place = str(given[0]) if given else ""
        if event in TOUCHES and (place.startswith(ours) or not event.startswith(("open", "os.", "glob"))):
            note(f"{event} {place}")

    def noting(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *given, **more: (note(name), original(*given, **more))[1]

    for cls, names in ((Database, ("read", "write")), (DataDirectory, ("free_bytes", "draft", "scratch"))):
        for name in names:
            patch.setattr(cls, name, noting(f"{cls.__name__}.{name}", getattr(cls, name)))
    WATCHED.append(heard)
    try:
        yield seen
    finally:
        WATCHED.remove(heard)


def test_no_route_touches_files_or_the_database_on_the_event_loop(
    client: TestClient, uploaded: Uploaded, lift: dict[str, Any], scene: TinyScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = {"lift": lift["id"], "text": "apple", "view": "left"}
    bodies = {"/lift": uploaded.order(stride=0), "/tradeoff": uploaded.order(stride=0)}
    with touches_on_the_loop(client, monkeypatch) as seen:
        for method, path in every_route(app_of(client)):
            if method == "DELETE" or path.endswith("/cancel"):
                continue  # of things that other tests need: `address` names none below
            where = address(path, lift["id"], "splats" if method == "PUT" else uploaded.cameras)
            body = {"json": bodies.get(path, {**asked, "text": ["apple"]})} if method == "POST" else {}
            known = set(asked) if path.startswith("/query") else {"lift", "view"} if path == "/render" else set()
            known -= {"view"} if path in ("/query/scores", "/query/splats", "/query/objects") else set()
            how: dict[str, Any] = {"content": scene.splats} if method == "PUT" else body
            client.request(method, where, params={name: asked[name] for name in known if method == "GET"}, **how)
        client.delete(address("/jobs/{job}", "0" * 32, ""))
        client.delete(f"/assets/{uploaded.splats}")  # refused: a lift needs it
        client.put("/assets/cameras", content=b"no cameras")
        assert not seen


def test_upload_to_a_stalled_disk_keeps_nobody_else_waiting(
    start: Start, scene: TinyScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    stalled, released = threading.Event(), threading.Event()

    def stall(files: DataDirectory, coming: int = 0) -> None:
        stalled.set()
        assert released.wait(120)
        raise NoSpace("data", expected="a disk that answers", got="one that did not")

    with start() as client:
        monkeypatch.setattr(DataDirectory, "require_room", stall)
        uploads = [
            threading.Thread(target=client.put, args=("/assets/splats",), kwargs={"content": scene.splats})
            for _ in range(50)  # more than there are threads
        ]
        for upload in uploads:
            upload.start()
        try:
            assert stalled.wait(60)
            for path in ("/healthz", "/version", "/jobs", "/assets", "/metrics", "/"):
                assert client.get(path).status_code == 200
            assert "disk" in assert_problem(client.get("/readyz"))["argument"]
        finally:
            released.set()
            for upload in uploads:
                upload.join()


@pytest.mark.parametrize(("seconds", "at_once"), [(1000.0, middleware.PLACES), (0.001, 2 * middleware.PLACES)])
def test_few_requests_begin_at_a_time_and_none_waits_for_slow_ones(
    monkeypatch: pytest.MonkeyPatch, seconds: float, at_once: int
) -> None:
    monkeypatch.setattr(middleware, "TURN_SECONDS", seconds)
    begun: list[str] = []

    async def ask_all() -> None:
        go_on = anyio.Event()

        async def app(scope: Any, receive: Any, send: Any) -> None:
            begun.append(scope["path"])
            if scope["path"] == "/slow":
                await go_on.wait()

        turns: Any = middleware.Turns(app)
        async with anyio.create_task_group() as asked:
            for path in ["/slow"] * 2 * middleware.PLACES + ["/healthz"]:
                asked.start_soon(turns, {"type": "http", "path": path}, None, None)
            while "/healthz" not in begun or begun.count("/slow") < at_once:
                await anyio.sleep(0.001)
            assert begun.count("/slow") == at_once
            go_on.set()
        assert begun.count("/slow") == 2 * middleware.PLACES

    anyio.run(ask_all)


def test_settings_are_bounded_before_they_are_looked_at(client: TestClient, uploaded: Uploaded) -> None:
    for settings in (
        {f"name{number}": 1 for number in range(MAX_SETTINGS + 1)},
        {"n" * 10_000: 1},
        {"preset": "x" * 10_000},
    ):
        for path in ("/lift", "/tradeoff"):
            told = assert_problem(client.post(path, json=uploaded.order() | {"settings": settings}))
            assert (told["status"], told["argument"]) == (422, "settings")
            assert f"at most {MAX_SETTINGS} settings" in told["expected"]


# Lists


@pytest.mark.parametrize("path", ["jobs", "lifts", "assets"])
def test_list_in_pages_is_the_list_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    monkeypatch.setattr("service.content.STREAMED", 2)
    with guarded(tmp_path / "data") as house:
        for _ in range(3):
            house.store.jobs.submit(SERVICE, house.order)
        whole = house.ask("boss", "GET", f"/{path}")
        assert list(whole.json()) == [path]
        found, cursor = [], {}
        while cursor is not None:
            page = house.ask("boss", "GET", f"/{path}", params={"limit": 2} | cursor).json()
            assert len(page[path]) <= 2
            found += page[path]
            cursor = None if page["next"] is None else {"cursor": page["next"]}
        assert found == whole.json()[path] and len(found) == {"jobs": 6, "lifts": 1, "assets": 3}[path]
        assert house.ask("boss", "GET", f"/{path}", params={"cursor": "x"}).status_code == 422
        assert house.ask("boss", "GET", f"/{path}", params={"limit": 0}).status_code == 422


def test_very_many_names_are_told_apart_in_pages(client: TestClient) -> None:
    document = cameras_document()
    frame, long = document["frames"][0], "a" * 400
    names = [f"{long}{number:04}" for number in range(SHOWN_CHARACTERS // 400 + 1)]
    document["frames"] = [frame | {"file_path": f"images/{name}.png"} for name in names]
    asset = put(client, AssetKind.CAMERAS, json.dumps(document).encode())
    told = client.get(f"/assets/{asset}")
    assert "names" not in told.json()["counts"] and len(told.content) < 10_000
    first = client.get(told.json()["links"]["names"], params={"limit": 500}).json()
    rest = client.get(told.json()["links"]["names"], params={"cursor": first["next"]}).json()
    assert sorted(first["names"] + rest["names"]) == names and rest["next"] is None
    assert client.delete(f"/assets/{asset}").status_code == 204


def test_lift_of_very_many_views_tells_their_names_apart_in_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lifted = [f"{'a' * 100}{number:04}" for number in range(3000)]
    with guarded(tmp_path / "data", views=lifted) as house:
        path = f"/lifts/{house.done}"
        told = house.ask("alice", "GET", path)
        assert (told.json()["views"], told.json()["view_count"]) == ([], 3000) and len(told.content) < 4000
        assert told.json()["certificate"] == {"warnings": ["x"]}  # and no names of views in it
        assert house.ask("alice", "GET", "/lifts").json()["lifts"] == [told.json()]
        numbers = {"width": 1, "height": 1, "fx": 1, "fy": 1, "cx": 1, "cy": 1, "viewmat": [[1.0]]}
        page = Frame({"views": [{"name": name, **numbers} for name in (lifted[7], "another")], "more": True})
        monkeypatch.setattr(NoQueries, "call", lambda *given: page, raising=False)
        views = house.ask("alice", "GET", told.json()["links"]["views"], params={"limit": 2}).json()
        assert [(view["name"], view["lifted"]) for view in views["views"]] == [(lifted[7], True), ("another", False)]
        assert views["next"] == 2
    with guarded(tmp_path / "few") as house:
        told = house.ask("alice", "GET", f"/lifts/{house.done}").json()
        assert (told["views"], told["view_count"]) == (["v"], 1)


# What browsers are told, and what the log leaves out


def test_every_answer_tells_browsers_to_guess_and_frame_nothing(client: TestClient) -> None:
    for path in ("/", "/docs", "/healthz", "/nowhere", "/assets", "/lifts/x"):
        told = client.get(path).headers
        assert (told["x-content-type-options"], told["x-frame-options"]) == ("nosniff", "DENY"), path
        assert "default-src 'none'" in told["content-security-policy"], path
        assert "frame-ancestors 'none'" in told["content-security-policy"], path
    policy = client.get("/").headers["content-security-policy"]
    assert "script-src 'self' 'wasm-unsafe-eval'; style-src 'self';" in policy  # its own files alone
    assert "http" not in policy and "unsafe-inline" not in policy and "'unsafe-eval'" not in policy


def test_log_of_one_thing_again_and_again_is_thinned_out() -> None:
    now = [0.0]
    sparing, access = Sparing(lambda: now[0]), logging.LogRecord("service.access", 20, "x", 1, "m", (), None)
    repeated = [logging.LogRecord("service.jobs", 40, "x", 1, "m", (), None) for _ in range(10_000)]
    assert sum(map(sparing.filter, repeated)) == SAME_A_MINUTE
    assert all(sparing.filter(access) for _ in range(1000))
    now[0] = 61
    late = logging.LogRecord("service.jobs", 40, "x", 1, "m", (), None)
    assert sparing.filter(late) and vars(late)["fields"] == {"left_out": 10_000 - SAME_A_MINUTE}
