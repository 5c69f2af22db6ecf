"""`splatlift view`: one lift on the page of a server of its own, by links, until it is interrupted."""

from __future__ import annotations

import io
import os
import re
import signal
import socket
import subprocess
import sys
import zipfile
from pathlib import Path

import httpx
import pytest

from liftcore.io.lift_file import save_lift
from liftcore.io.scene_files import lift_files
from liftcore.settings import LiftSettings
from service.view import main
from tests.crash.conftest import until

from .tiny_scene import colmap_zip, make_scene

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The tiny scene with cameras of either kind, and its lift with a folder of them."""
    tiny = make_scene()
    with zipfile.ZipFile(io.BytesIO(colmap_zip())) as model:
        model.extractall(tmp_path / "scene")
    for name, content in (("s.ply", tiny.splats), ("c.json", tiny.cameras), ("f.safetensors", tiny.features)):
        (tmp_path / name).write_bytes(content)
    files = tmp_path / "s.ply", tmp_path / "scene", [tmp_path / "f.safetensors"]
    save_lift(lift_files(*files, LiftSettings.of(preset="row-sum")), tmp_path / "l.safetensors")
    return tmp_path


def test_lift_is_shown_by_links_until_it_is_interrupted(folder: Path) -> None:
    temporary = folder / "temporary"
    temporary.mkdir()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    command = [sys.executable, "-m", "liftcore.cli", "view", str(folder / "l.safetensors"), "--no-browser"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(temporary)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as server:
        assert server.stdout is not None
        line = server.stdout.readline()
        found = re.match(r"(http://127\.0\.0\.1:\d+)/\?lift=(\w+) ", line)
        assert found, line
        with httpx.Client(base_url=found[1], timeout=600) as client:
            assert client.get(f"/?lift={found[2]}").status_code == 200
            assert client.get(f"/lifts/{found[2]}").json()["count"] == 60
            answer = client.get("/query", params={"like": "region:left:0:2", "threshold": 0.5}).json()
            assert answer["count"] == 20
            assert client.get("/render", params={"view": "middle"}).status_code == 200
            deleted = client.delete(f"/jobs/{found[2]}", params={"with_lift": True})
            assert deleted.status_code == 204
        server.send_signal(signal.SIGINT)
        assert server.wait(timeout=600) == 0
    assert not list(temporary.iterdir())
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_lift_in_memory_is_shown_until_it_is_interrupted_or_killed(folder: Path) -> None:
    script = """if True:
        import signal, socket
        import liftcore as lc
        signal.signal(signal.SIGINT, signal.default_int_handler)  # who runs tests in the background ignores it
        splats, cameras = lc.read_splats("s.ply"), dict(lc.read_cameras("c.json"))
        result = lc.lift(splats, cameras, lc.read_features("f.safetensors"), preset="row-sum")
        two = {name: getattr(splats, name)[:2] for name in ("means", "quats", "log_scales", "opacity_logits")}
        for given in ({}, {"splats": splats}, {"splats": lc.Splats(**two, kernel="3dgs"), "cameras": cameras}):
            try:
                result.show(**given)
            except lc.InvalidInput as error:
                print(error.argument, flush=True)
        try:
            with socket.create_server(("127.0.0.1", 0)) as taken:
                result.show(splats, cameras, port=taken.getsockname()[1], browser=False)
        except lc.Unavailable as error:
            print(error.argument, flush=True)
        result.show(splats, cameras, browser=False)
        print("ended", flush=True)
        input()
        result.show(splats, cameras, browser=False)
    """
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(folder)}
    command, pipe = [sys.executable, "-c", script], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment, cwd=folder) as process:
        assert process.stdout is not None
        told = [process.stdout.readline().strip() for _ in range(4)]
        assert told == ["splats", "cameras", "splats", "the page"]
        line = process.stdout.readline()
        found = re.match(r"(http://127\.0\.0\.1:\d+)/\?lift=(\w+) ", line)
        assert found, line
        with httpx.Client(base_url=found[1], timeout=600) as client:
            assert client.get("/query", params={"like": "splat:45", "threshold": 0.5}).json()["count"] == 20
            assert client.get("/render", params={"view": "middle"}).status_code == 200
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "ended\n"
        assert not list(folder.glob("splatlift*"))
        assert process.stdin is not None
        print(file=process.stdin, flush=True)
        found = re.match(r"http://(127\.0\.0\.1):(\d+)/", process.stdout.readline())
        assert found
        process.kill()  # as a notebook's kernel may be
    until(lambda: not _answers(found[1], int(found[2])))


def test_lift_whose_files_moved_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "s.ply").unlink()
    for lift, told in (("l.safetensors", "its splats at"), ("f.safetensors", "a lift file")):
        assert main([str(folder / lift), "--no-browser"]) == 2
        assert told in capsys.readouterr().err


def _answers(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port)).close()
    except ConnectionRefusedError:
        return False
    return True
