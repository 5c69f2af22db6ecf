"""No file takes the check down, or more than its share: a corpus of bombs, and real files with bytes changed."""

from __future__ import annotations

import gzip
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from service.child import error_of
from service.models import AssetKind
from service.problems import problem_of
from service.uploads import check

from .bombs import camera_documents, features
from .tiny_scene import TinyScene, colmap_zip, labels, make_scene, masks

ROOT = Path(__file__).parents[2]
BOMBS = {"splats": 10, "cameras": 23, "features": 18, "masks": 22, "table": 26, "photos": 9}  # how many there are
MEMORY_BYTES = 1 << 30  # private memory for the whole corpus of a kind, made and read in one process
SECONDS = 300  # for the same; it takes a few, and the machine may be busy
ALL_IN_ONE_PROCESS = """
import json, resource, sys
from pathlib import Path
from service.uploads import check
from service.models import AssetKind
from tests.api.bombs import CORPUS
kind, folder = AssetKind(sys.argv[1]), Path(sys.argv[2])
found = {}
corpus = CORPUS[kind]()
resource.setrlimit(resource.RLIMIT_DATA, (int(sys.argv[3]),) * 2)
for name, content in corpus.items():
    path = folder / f"draft.{kind}"
    path.write_bytes(content)
    found[name] = check.run(kind, str(path))
print(json.dumps(found))
"""


@pytest.mark.parametrize("kind", list(AssetKind))
def test_every_bomb_is_refused_in_one_line_within_time_and_memory(tmp_path: Path, kind: AssetKind) -> None:
    command = [sys.executable, "-c", ALL_IN_ONE_PROCESS, kind, str(tmp_path), str(MEMORY_BYTES)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, check=True, timeout=SECONDS, env=environment, cwd=ROOT)
    found = json.loads(done.stdout)
    assert len(found) == BOMBS[kind]
    for name, said in found.items():
        assert said["event"] == "invalid", name
        problem = problem_of(error_of(said["fault"]))
        assert (problem.status, problem.type) == (422, f"/problems/invalid-{kind}"), name
        assert problem.expected and problem.got and "memory" not in problem.expected, name
        assert len(problem.detail) < 1_000 and "\n" not in problem.detail, name


@pytest.mark.parametrize(
    ("kind", "corpus", "name"),
    [
        ("cameras", camera_documents, "half a surrogate pair in a name"),
        ("cameras", camera_documents, "deep object"),
        ("features", features, "a tensor twice"),
    ],
)
def test_bomb_over_http_is_a_problem_and_the_service_lives(
    client: TestClient, kind: str, corpus: Callable[[], dict[str, bytes]], name: str
) -> None:
    reply = client.put(f"/assets/{kind}", content=corpus()[name])
    assert (reply.status_code, reply.json()["type"]) == (422, f"/problems/invalid-{kind}")
    assert client.get("/healthz").status_code == 200


REAL: TinyScene = make_scene()
BROUGHT = [path for path in (ROOT / "tests/data/splats").glob("degree3.*") if "decoded" not in path.name]
FILES = [
    *((AssetKind.SPLATS, path.read_bytes()) for path in sorted(BROUGHT)),
    (AssetKind.SPLATS, REAL.splats),
    (AssetKind.CAMERAS, REAL.cameras),
    (AssetKind.CAMERAS, colmap_zip()),
    (AssetKind.FEATURES, REAL.features),
    (AssetKind.MASKS, masks({"left": labels()["left"][0]})),
    (AssetKind.TABLE, REAL.table),
]
GZIP = b"\x1f\x8b"
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
    packed = content[:2] == GZIP and early  # else what is changed is the stream, which hardly ever ends well
    content = gzip.decompress(content) if packed else content
    reach = min(len(content), 700) if early else len(content)  # headers lie at the beginning
    for where, gone, come in changes:
        place = int(where * reach)
        content = content[:place] + come + content[place + gone :]
    content = content[: round(end * len(content))] if end < 1 else content
    path = tmp_path / f"draft.{kind}"
    path.write_bytes(gzip.compress(content) if packed else content)
    said = check.run(kind, str(path))
    if said["event"] == "valid":
        json.dumps(said, allow_nan=False, ensure_ascii=False).encode()
    else:
        problem = problem_of(error_of(said["fault"]))
        assert problem.status == 422 and problem.expected and problem.got
