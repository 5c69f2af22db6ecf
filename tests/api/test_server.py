"""The real server process: what it binds, prints and loads, and that it answers; and the page of one lift."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import httpx
import pytest

from liftcore.cli import build_parser, main
from liftcore.lifting.files import lift_files
from liftcore.query.question import page_fields
from liftcore.values.lift_file import save_lift
from liftcore.values.settings import LiftSettings
from service.commands.serve import settings_of
from service.errors import InvalidRequest
from service.routes.operations import WEB
from service.settings import ServiceSettings, encoder_spec
from tests.crash.conftest import until
from tests.tiny_scene import colmap_zip, make_scene

ROOT = Path(__file__).parents[2]


@contextmanager
def server(data: Path, table: Path, stderr: IO[str] | None = None) -> Iterator[str]:
    """Run a server process and yield its address. On SIGTERM it must exit with status 0."""
    encoders = ["--encoder", f"table:{table}", "--text-space", f"tiny=table:{table}"]
    command = [sys.executable, "-m", "service", "--port", "0", "--data", str(data), *encoders]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True, cwd=ROOT)
    with process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("listening on http://127.0.0.1:"), line
            yield line.split()[-1]
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 0


@pytest.mark.parametrize("allowed_proxies", ["", "10.0.0.0/8,127.0.0.1"])
def test_client_of_a_proxy_is_believed_where_the_operator_names_the_proxy(
    allowed_proxies: str, tmp_path: Path, table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATLIFT_FORWARDED_ALLOW", allowed_proxies)
    with (tmp_path / "log").open("w") as stderr, server(tmp_path / "data", table, stderr=stderr) as address:
        httpx.get(f"{address}/healthz", headers={"X-Forwarded-For": "192.0.2.7"})
    messages = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    clients = [line["client"] for line in messages if line["logger"] == "service.access"]
    assert clients == ["192.0.2.7" if allowed_proxies else "127.0.0.1"]


def test_http_process_loads_neither_torch_nor_numba_nor_hdbscan() -> None:
    code = (
        "import sys, service.app, service.commands.serve, service.commands.view\n"
        "print(sorted({'torch', 'numba', 'hdbscan', 'plyfile', 'open_clip'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert result.stdout.strip() == "[]"


def test_variable_that_is_no_json_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SPLATLIFT_TEXT_SPACES", "{bad")
    for command in (["serve"], ["keys", "list"]):
        assert main([*command, "--data", str(tmp_path)]) == 2
        output = capsys.readouterr().err
        assert "SPLATLIFT_TEXT_SPACES: expected JSON, got '{bad'" in output and output.count("\n") == 1


def test_settings_come_from_the_environment_and_the_command_line_wins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def serve(*arguments: str) -> ServiceSettings:
        return settings_of(build_parser().parse_args(["serve", *arguments]))

    monkeypatch.setenv("SPLATLIFT_PORT", "1234")
    monkeypatch.setenv("SPLATLIFT_QUERY_SECONDS", "7")
    monkeypatch.setenv("SPLATLIFT_TEXT_SPACES", '{"a": "lvis"}')
    assert (serve().port, serve().query_seconds) == (1234, 7)
    assert serve().text_spaces == {"a": "lvis"}
    assert serve("--port", "1", "--text-space", "a=table:x=y").text_spaces == {"a": "table:x=y"}
    for name in ("COMMIT", "PORT", "ALLOWED_HOSTS", "TEXT_SPACES"):  # empty, it is as if it were not set
        monkeypatch.setenv(f"SPLATLIFT_{name}", "")
    assert (serve().commit, serve().port, serve().allowed_hosts) == (None, 8787, ())


def test_encoder_is_chosen_by_text_space_and_never_by_the_client(tmp_path: Path) -> None:
    settings = ServiceSettings.model_validate({"data": tmp_path, "text_spaces": {"clip": "open_clip:X@w.pt"}})
    assert encoder_spec(settings, "clip", None) == "open_clip:X@w.pt"
    for space, encoder in (("open_clip:ViT-B-32/openai", "lvis"),):  # they need no file
        assert encoder_spec(settings, space, None) == encoder_spec(settings, space, space) == encoder
    assert encoder_spec(settings, "clip", "default") == "lvis"
    assert encoder_spec(settings, "none", "clip") == "open_clip:X@w.pt"
    for space, encoder_name in (("clip", "table:secret"), ("none", None)):
        with pytest.raises(InvalidRequest, match="expected"):
            encoder_spec(settings, space, encoder_name)


def test_default_encoder_stands_in_for_other_spaces_only_where_the_operator_chose_it(tmp_path: Path) -> None:
    untouched = ServiceSettings.model_validate({"data": tmp_path})
    for space in ("dino", ""):
        with pytest.raises(InvalidRequest, match="SPLATLIFT_TEXT_SPACES"):
            encoder_spec(untouched, space, None)
        assert encoder_spec(untouched, space, "default") == "lvis"
    server_settings = ServiceSettings.model_validate({"data": tmp_path, "encoder": "lvis"})
    assert encoder_spec(server_settings, "dino", None) == encoder_spec(server_settings, "", None) == "lvis"
    with pytest.raises(InvalidRequest, match="none"):
        encoder_spec(server_settings, "none", None)


def test_built_page_is_of_these_sources() -> None:
    web = WEB.parent
    sources = [
        *(path.relative_to(web).as_posix() for path in (web / "src").iterdir()),
        "build.mjs",
        "package-lock.json",
    ]
    digest = hashlib.sha256()
    for name in sorted(sources):
        digest.update(f"{name}\0{(web / name).read_text(encoding='utf-8')}\0".encode())
    messages = f"sources sha256:{digest.hexdigest()}"
    for name in ("page.js", "page.css"):
        assert messages in (WEB / name).read_text(encoding="utf-8").split("\n", 1)[0], "run `make web`"
    assert (WEB / "page.html").read_text(encoding="utf-8").count(f"?{digest.hexdigest()[:16]}") == 2


def test_page_knows_every_field_of_a_question() -> None:
    built_file = WEB.parent / "src" / "question.json"
    assert json.loads(built_file.read_text(encoding="utf-8")) == page_fields(), "run `make web`"


def test_page_names_its_libraries_and_no_registry() -> None:
    lock = (WEB.parent / "package-lock.json").read_text(encoding="utf-8")
    assert "resolved" not in lock and "://" not in lock
    exact = json.loads((WEB.parent / "package.json").read_text(encoding="utf-8"))
    assert all(
        version[0].isdigit() for kind in ("dependencies", "devDependencies") for version in exact[kind].values()
    )
    licences = (WEB / "LICENSES.txt").read_text(encoding="utf-8")
    assert (
        all(name in licences for name in exact["dependencies"])
        and licences.count("Permission is hereby granted") == 4
        and "SIL Open Font License" in licences
    )


# `splatlift view`: one lift on the page of a server of its own


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
        match = re.match(r"(http://127\.0\.0\.1:\d+)/\?lift=(\w+) ", line)
        assert match, line
        with httpx.Client(base_url=match[1], timeout=600) as client:
            assert client.get(f"/?lift={match[2]}").status_code == 200
            assert client.get(f"/lifts/{match[2]}").json()["count"] == 60
            answer = client.get("/query", params={"like": "region:left:0:2", "threshold": 0.5}).json()
            assert answer["count"] == 20
            assert client.get("/render", params={"view": "middle"}).status_code == 200
            deleted = client.delete(f"/jobs/{match[2]}", params={"with_lift": True})
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
            print(error.argument, error.got.partition(";")[0], flush=True)
        result.show(splats, cameras, browser=False)
        print("ended", flush=True)
        input()
        result.show(splats, cameras, browser=False)
    """
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(folder)}
    command, pipe = [sys.executable, "-c", script], subprocess.PIPE
    with (
        (folder / "stderr").open("w") as errors,
        subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=errors, text=True, env=environment, cwd=folder
        ) as process,
    ):
        assert process.stdout is not None
        messages = [process.stdout.readline().strip() for _ in range(4)]
        assert messages == ["splats", "cameras", "splats", "the page one that ended with status 2"]
        line = process.stdout.readline()
        match = re.match(r"(http://127\.0\.0\.1:\d+)/\?lift=(\w+) ", line)
        assert match, line
        with httpx.Client(base_url=match[1], timeout=600) as client:
            assert client.get("/query", params={"like": "splat:45", "threshold": 0.5}).json()["count"] == 20
            assert client.get("/render", params={"view": "middle"}).status_code == 200
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "ended\n"
        assert not list(folder.glob("splatlift*"))
        assert process.stdin is not None
        print(file=process.stdin, flush=True)
        match = re.match(r"http://(127\.0\.0\.1):(\d+)/", process.stdout.readline())
        assert match
        process.kill()  # as a notebook's kernel may be
    until(lambda: not _answers(match[1], int(match[2])) and not list(folder.glob("splatlift*")))
    assert "Fatal" not in (folder / "stderr").read_text()


def test_lift_whose_files_moved_is_an_error(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "s.ply").unlink()
    for lift, messages in (
        ("l.safetensors", "its splats at"),
        ("f.safetensors", "expected lift as LIFT, got features"),
    ):
        assert main(["view", str(folder / lift), "--no-browser"]) == 2
        assert messages in capsys.readouterr().err


def test_view_removes_no_folder_that_show_did_not_make(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in (tmp_path / "data", tmp_path / "splatlift-show-mine"):
        folder.mkdir()
        lift = str(tmp_path / "l.safetensors")
        for option in ("--lent", "--len", "--le"):
            assert main(["view", lift, "--no-browser", option, str(folder)]) == 2
        monkeypatch.setenv("SPLATLIFT_SHOW_FOLDER", str(folder))
        assert main(["view", lift, "--no-browser"]) == 2
        assert "SPLATLIFT_SHOW_FOLDER" in capsys.readouterr().err and folder.is_dir()


def _answers(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port)).close()
    except ConnectionRefusedError:
        return False
    return True
