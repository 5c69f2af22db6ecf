"""What is no file of its kind is refused in one line; nothing is unpickled, and bombs take no memory."""

from __future__ import annotations

import json
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import liftcore as lc
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from liftcore import evaluate
from liftcore.errors import InvalidMasks, InvalidPhotos, InvalidTable

from tests import tiny_scene
from tests.promises.bad_files import (
    BAD_FILES,
    BAD_FOLDERS,
    BINARY,
    MODEL,
    SPLATS,
    BadFile,
    BadFolder,
    Intruder,
    table_of,
)
from tests.promises.command_line import error_line
from tests.promises.tiny_files import write_files

MEMORY = 150 << 20  # bytes above the file itself, for any bomb


def read_views(path: Path) -> Any:
    """Read every view of a pack, as a lift does."""
    views = lc.read_features(path)
    return [views[name] for name in views]


READERS: dict[str, tuple[Callable[[Path], Any], type[lc.SplatliftError]]] = {
    "splats": (lc.read_splats, lc.InvalidSplats),
    "cameras": (lc.read_cameras, lc.InvalidCameras),
    "features": (read_views, lc.InvalidFeatures),
    "table": (lambda path: lc.open_encoder(f"table:{path}"), InvalidTable),
    "masks": (lambda path: evaluate.inspect_file(path, "masks"), InvalidMasks),
    "photos": (lambda path: evaluate.inspect_file(path, "photos"), InvalidPhotos),
    "lift": (lc.load_lift, lc.InvalidLift),
}


def assert_one_line(error: lc.SplatliftError, word: str) -> None:
    text = str(error)
    assert word in text, text
    assert "\n" not in text and len(text) < 900
    assert error.argument and error.expected and error.got


def identity(row: BadFile | BadFolder) -> str:
    return f"{row.kind}: {row.name}"


@pytest.mark.parametrize("row", BAD_FILES, ids=identity)
def test_bad_file_is_refused_in_one_line(row: BadFile, tmp_path: Path) -> None:
    path, (reader, error_type) = tmp_path / "upload", READERS[row.kind]
    path.write_bytes(row.data())
    if row.bomb:
        tracemalloc.start()
    try:
        with pytest.raises(error_type) as error:
            reader(path)
        if row.bomb:
            assert tracemalloc.get_traced_memory()[1] < MEMORY
    finally:
        tracemalloc.stop()
    assert_one_line(error.value, row.word)
    assert not Intruder.ran
    assert [place.name for place in tmp_path.iterdir()] == ["upload"]


@pytest.mark.parametrize("row", BAD_FOLDERS, ids=identity)
def test_bad_folder_is_refused_in_one_line(row: BadFolder, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, content in row.files.items():
        (folder / name).write_bytes(content)
    kind: Any = row.kind
    error_type, out = lc.InvalidFeatures, tmp_path / "pack.safetensors"
    if row.kind in READERS and row.kind != "masks":
        _, error_type = READERS[row.kind]
    with pytest.raises(error_type) as error:
        if row.kind in ("masks", "npy"):
            lc.pack_folder(folder, out, kind, progress=False)
        else:
            READERS[row.kind][0](folder)
    assert_one_line(error.value, row.word)
    assert not Intruder.ran and not out.exists()


def test_odd_table_is_described_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "upload"
    path.write_bytes(table_of("[" * 100_000))
    assert evaluate.inspect_file(path)["words"] == []
    path.write_bytes(table_of(["a"], 0.0))
    with pytest.raises(InvalidTable):
        evaluate.inspect_file(path)


@pytest.mark.parametrize("kind", READERS)
def test_command_line_refuses_a_bad_file_with_exit_2(kind: str, tmp_path: Path) -> None:
    row = next(row for row in BAD_FILES if row.kind == kind and not row.bomb)
    path = tmp_path / "bad"
    path.write_bytes(row.data())
    inputs = {name: file for name, file in write_files(tmp_path).items() if name != "table"}
    before = sorted(tmp_path.iterdir())
    lift = ["lift", *(inputs | {kind: path}).values(), "-o", tmp_path / "out"]
    assert str(path) in error_line(*(lift if kind in inputs else ["inspect", path]))
    assert sorted(tmp_path.iterdir()) == before


def with_header(content: bytes, length: int) -> bytes:
    """Return a safetensors file whose header is padded to a length in bytes."""
    end = 8 + int.from_bytes(content[:8], "little")
    return length.to_bytes(8, "little") + content[8:end].ljust(length) + content[end:]


def samples() -> list[tuple[str, str, bytes, dict[str, bytes]]]:
    """Return (kind, name, a good file, files beside it) of every format that is read."""
    scene = tiny_scene.make_scene()
    record = {
        "id": 0,
        "img_name": "a",
        "width": 64,
        "height": 48,
        "fx": 50.0,
        "fy": 50.0,
        "position": [0.0, 0.0, 0.0],
    }
    record["rotation"] = np.eye(3).tolist()
    rows = [
        ("splats", "tiny.ply", scene.splats, {}),
        ("cameras", "transforms.json", scene.cameras, {}),
        ("cameras", "cameras.json", json.dumps([record]).encode(), {}),
        ("cameras", "model.zip", tiny_scene.colmap_zip(), {}),
        ("features", "pack", scene.features, {}),
        ("table", "table", scene.table, {}),
        ("masks", "masks", tiny_scene.masks({"left": np.zeros((4, 6), int)}), {}),
    ]
    # Headers whose lengths read like the first bytes of pickles and of zips.
    rows += [("masks", f"header {length}", with_header(rows[-1][2], length), {}) for length in (640, 66_176, 19_280)]
    names = [path.name for path in SPLATS.iterdir() if not path.name.endswith(".decoded.ply")]
    rows += [("splats", name, (SPLATS / name).read_bytes(), {}) for name in sorted(names)]
    for model in (BINARY, MODEL):
        for name, content in model.items():
            rows.append(("cameras", name, content, {other: data for other, data in model.items() if other != name}))
    return rows


SAMPLES = samples()


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: sample[1])
def test_sample_of_every_format_is_read(sample: tuple[str, str, bytes, dict[str, bytes]], tmp_path: Path) -> None:
    kind, name, content, siblings = sample
    for file, data in {**siblings, name: content}.items():
        (tmp_path / file).write_bytes(data)
    assert READERS[kind][0](tmp_path / name if not siblings else tmp_path) is not None


@given(
    st.sampled_from(SAMPLES),
    st.lists(st.tuples(st.integers(0, 3000), st.integers(0, 255)), max_size=5),
    st.one_of(st.none(), st.integers(0, 3000)),
)
@settings(max_examples=300)
def test_any_damage_is_read_or_refused_in_one_line(
    sample: tuple[str, str, bytes, dict[str, bytes]], changes: list[tuple[int, int]], cut: int | None
) -> None:
    kind, name, content, siblings = sample
    damaged = bytearray(content)
    for place, value in changes:
        damaged[place % len(damaged)] = value
    reader, error_type = READERS[kind]
    with tempfile.TemporaryDirectory() as folder:
        for file, data in {**siblings, name: bytes(damaged[:cut])}.items():
            (Path(folder) / file).write_bytes(data)
        try:
            reader(Path(folder) / name if not siblings else Path(folder))
        except error_type as error:
            assert "\n" not in str(error) and error.argument and error.expected and error.got
