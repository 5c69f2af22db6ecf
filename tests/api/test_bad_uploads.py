"""Bad uploads, bombs too, are the client's error: one line each; they leave no files and take little memory."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from service import tasks
from service.child import error_of
from service.models import AssetKind
from service.problems import problem_of
from tests.tiny_scene import (
    TinyScene,
    cameras_document,
    codebook,
    colmap_zip,
    labels,
    make_scene,
    masks,
    pack,
    ply,
    splat_rows,
)

from .bombs import camera_documents, features
from .test_problems import assert_problem


def files_below(data: Path) -> set[str]:
    """Every file but the database's own and the number beside it, which is written as the server starts."""
    files = (path for path in data.rglob("*") if path.is_file())
    return {str(path) for path in files if not path.name.startswith(("service.sqlite", "generation", ".generation"))}


def with_label_out_of_the_codebook() -> bytes:
    by_view = {name: view.copy() for name, view in labels().items()}
    by_view["left"][0, 3, 3] = 3
    return pack(by_view)


def camera_of(image: str) -> bytes:
    document = cameras_document()
    document["frames"][1]["file_path"] = image
    return json.dumps(document).encode()


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        (AssetKind.SPLATS, ply(splat_rows())[:-10]),
        (AssetKind.CAMERAS, camera_of("a" * 501)),
        (AssetKind.FEATURES, with_label_out_of_the_codebook()),
        (AssetKind.MASKS, masks({"left": np.full((2, 3), -2)})),
        (AssetKind.MASKS, save({"left": codebook()})),
        (AssetKind.TABLE, save({"embeddings": np.eye(2, 3), "more": np.eye(2)}, metadata={"words": '["a", "b"]'})),
        (AssetKind.TABLE, save({"embeddings": codebook()[:1]}, metadata={"words": '["\\ud800"]'})),
        (AssetKind.PHOTOS, b"no zip"),
    ],
    ids=lambda value: value if isinstance(value, AssetKind) else "",  # bytes differ from process to process
)
def test_malformed_upload_is_refused_and_gone(
    client: TestClient, data: Path, kind: AssetKind, content: bytes
) -> None:
    before = files_below(data)
    reply = client.put(f"/assets/{kind}", content=content)
    problem = assert_problem(reply)
    assert (problem["status"], problem["type"]) == (422, f"/problems/invalid-{kind}")
    assert problem["expected"] and problem["got"]
    assert str(data) not in reply.text, "the server's paths are its own"
    assert files_below(data) == before
    assert client.get(f"/assets/sha256:{hashlib.sha256(content).hexdigest()}").status_code == 404


def test_names_of_cameras_are_as_long_as_a_query_may_say(tmp_path: Path) -> None:
    for image, message in (("a" * 500, None), ("a" * 501, "501: 'aaa"), ("", "an empty one")):
        path = tmp_path / "draft.cameras"
        path.write_bytes(camera_of(image))
        report = tasks.check(AssetKind.CAMERAS, str(path))
        assert report["event"] == ("valid" if message is None else "invalid")
        if message is not None:
            fault = report["fault"]
            assert (fault["argument"], fault["expected"]) == ("view name", "1 to 500 characters")
            assert fault["got"].startswith(message) and len(fault["got"]) < 60


def test_upload_beyond_the_limit_is_413(client: TestClient, data: Path) -> None:
    before = files_below(data)
    reply = client.put("/assets/splats", content=b"ply\n" + b"\0" * 200_000)
    assert (reply.status_code, reply.json()["type"]) == (413, "/problems/too-large")
    assert files_below(data) == before


@pytest.mark.parametrize("coding", ["gzip", "zstd", "br", "identity, gzip", "nonsense"])
def test_compressed_uploads_are_refused_with_a_hint(client: TestClient, data: Path, coding: str) -> None:
    before = files_below(data)
    reply = client.put("/assets/splats", content=b"...", headers={"Content-Encoding": coding})
    assert (reply.status_code, reply.json()["type"]) == (415, "/problems/unsupported-encoding")
    assert coding in reply.json()["got"] and "as it is" in reply.json()["hint"]
    assert files_below(data) == before


def test_wrong_digest_is_refused(client: TestClient, data: Path, scene: TinyScene) -> None:
    before = files_below(data)
    reply = client.put("/assets/splats", content=scene.splats, params={"sha256": "0" * 64})
    assert (reply.status_code, reply.json()["type"]) == (422, "/problems/digest-mismatch")
    assert files_below(data) == before


def test_check_that_takes_too_long_is_ended(start: Callable[..., TestClient], scene: TinyScene) -> None:
    with start(check_seconds=1e-6) as client:
        reply = client.put("/assets/splats", content=scene.splats)
    assert reply.status_code == 422 and "takes longer" in reply.json()["got"]


def test_check_that_needs_too_much_memory_is_ended(start: Callable[..., TestClient], scene: TinyScene) -> None:
    """It is the file's alone: what torch holds once it is imported, the more in CUDA builds, does not count."""
    rows = np.tile(splat_rows(), (20_000, 1))  # 67 MB, of which a reader holds several copies
    with start(check_memory_bytes=48 << 20) as client:
        small = client.put("/assets/splats", content=scene.splats)
        reply = client.put("/assets/splats", content=ply(rows))
    assert small.status_code == 201, small.text
    assert reply.status_code == 422, reply.text


ROOT = Path(__file__).parents[2]
MEMORY_BYTES = 700 << 20  # private memory for the whole corpus, made and read in one process, beside its imports
SECONDS = 600  # for the same; it takes some, and the machine may be busy
ALL_IN_ONE_PROCESS = """
import json, resource, sys
from pathlib import Path
from service.child import memory_of
from service import tasks
from tests.api.bombs import CORPUS
folder = Path(sys.argv[1])
resource.setrlimit(resource.RLIMIT_DATA, (memory_of("self", "VmData") + int(sys.argv[2]),) * 2)
for kind, corpus in CORPUS.items():
    for name, content in corpus().items():
        path = folder / f"draft.{kind}"
        path.write_bytes(content)
        print(json.dumps([kind, name, tasks.check(kind, str(path))]))
"""


def test_every_bomb_is_refused_in_one_line_within_time_and_memory(tmp_path: Path) -> None:
    command = [sys.executable, "-c", ALL_IN_ONE_PROCESS, str(tmp_path), str(MEMORY_BYTES)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    process = subprocess.run(command, capture_output=True, check=True, timeout=SECONDS, env=environment, cwd=ROOT)
    reports = [json.loads(line) for line in process.stdout.splitlines()]
    assert {kind for kind, _, _ in reports} == set(AssetKind)
    for kind, name, message in reports:
        assert message["event"] == "invalid", (kind, name)
        problem = problem_of(error_of(message["fault"]))
        assert (problem.status, problem.type) == (422, f"/problems/invalid-{kind}"), name
        assert problem.expected and problem.got and "memory" not in problem.expected, name
        assert len(problem.detail) < 1_000 and "\n" not in problem.detail, name
        assert str(tmp_path) not in problem.model_dump_json(), name


def test_bomb_over_http_is_a_problem_and_the_service_lives(client: TestClient) -> None:
    for kind, content in (
        ("cameras", camera_documents()["deep object"]),
        ("features", features()["a tensor twice"]),
    ):
        reply = client.put(f"/assets/{kind}", content=content)
        assert (reply.status_code, reply.json()["type"]) == (422, f"/problems/invalid-{kind}")
    assert client.get("/healthz").status_code == 200


REAL: TinyScene = make_scene()
EDITORS = [path for path in (ROOT / "tests/data/splats").glob("degree3.*") if "decoded" not in path.name]
FILES = [
    *((AssetKind.SPLATS, path.read_bytes()) for path in sorted(EDITORS)),
    (AssetKind.SPLATS, REAL.splats),
    (AssetKind.CAMERAS, REAL.cameras),
    (AssetKind.CAMERAS, colmap_zip()),
    (AssetKind.FEATURES, REAL.features),
    (AssetKind.MASKS, masks({"left": labels()["left"][0]})),
    (AssetKind.TABLE, REAL.table),
]
CHANGES = st.lists(
    st.tuples(
        st.floats(0, 1),  # where
        st.integers(0, 12),  # how many bytes go
        st.one_of(
            st.binary(max_size=8),
            st.sampled_from(
                [b"-1", b"1e999", b"NaN", b"[" * 50, b"\x00", b"\xff\xff\xff\xff", b'"', b"\\ud800", b"\n"]
            ),
        ),  # what comes
    ),
    min_size=1,
    max_size=4,
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(file=st.sampled_from(FILES), changes=CHANGES, end=st.floats(0.5, 1.5), early=st.booleans())
def test_real_file_with_changed_bytes_is_taken_or_refused_and_never_crashes(
    tmp_path: Path, file: tuple[AssetKind, bytes], changes: list[tuple[float, int, bytes]], end: float, early: bool
) -> None:
    kind, content = file
    packed = content[:2] == b"\x1f\x8b" and early  # else what is changed is the stream, which hardly ever ends well
    content = gzip.decompress(content) if packed else content
    reach = min(len(content), 700) if early else len(content)  # headers lie at the beginning
    for offset, old, new in changes:
        place = int(offset * reach)
        content = content[:place] + new + content[place + old :]
    content = content[: round(end * len(content))] if end < 1 else content
    path = tmp_path / f"draft.{kind}"
    path.write_bytes(gzip.compress(content) if packed else content)
    report = tasks.check(kind, str(path))
    if report["event"] == "valid":
        json.dumps(report, allow_nan=False, ensure_ascii=False).encode()
    else:
        problem = problem_of(error_of(report["fault"]))
        assert problem.status == 422 and problem.expected and problem.got
