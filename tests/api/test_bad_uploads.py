"""Bad uploads are the client's problem, told in one line, and leave nothing behind."""

from __future__ import annotations

import gzip
import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from fastapi.testclient import TestClient
from safetensors.numpy import save

from service.child import error_of
from service.errors import InvalidEncoding
from service.models import AssetKind
from service.problems import problem_of
from service.uploads import check, intake
from service.uploads.intake import GZIP, ZSTD, Coding, Decoding

from .tiny_scene import (
    PROPERTIES,
    WORDS,
    TinyScene,
    cameras_document,
    codebook,
    labels,
    masks,
    pack,
    ply,
    splat_rows,
    text_table,
)


def files_below(data: Path) -> set[str]:
    """Every file but the database's own and the number beside it, which is written as the server starts."""
    found = (path for path in data.rglob("*") if path.is_file())
    return {str(path) for path in found if not path.name.startswith(("service.sqlite", "generation", ".generation"))}


def truncated_ply() -> bytes:
    return ply(splat_rows())[:-10]


def header_bomb() -> bytes:
    return b"ply\nformat binary_little_endian 1.0\n" + b"comment " + b"x" * 150_000


def counting_bomb() -> bytes:
    return ply(splat_rows()).replace(b"element vertex 60", b"element vertex 6000000000")


def splat_with_nan() -> bytes:
    rows = splat_rows()
    rows[5, 0] = np.nan
    return ply(rows)


def wrong_property() -> bytes:
    return ply(splat_rows(), [name.replace("opacity", "opaqueness") for name in PROPERTIES])


def empty_scene() -> bytes:
    return ply(splat_rows()[:0])


def camera_without_pose() -> bytes:
    document = cameras_document()
    frames = document["frames"]
    assert isinstance(frames, list)
    del frames[1]["transform_matrix"]
    return json.dumps(document).encode()


def camera_of(image: str) -> bytes:
    document = cameras_document()
    frames = document["frames"]
    assert isinstance(frames, list)
    frames[1]["file_path"] = image
    return json.dumps(document).encode()


def nameless_camera() -> bytes:
    return camera_of("")


def camera_that_no_query_can_name() -> bytes:
    return camera_of("a" * 501)


def no_views() -> bytes:
    return json.dumps(cameras_document() | {"frames": []}).encode()


def distortion_that_turns_back() -> bytes:
    return json.dumps(cameras_document() | {"k1": -9.0, "camera_model": "OPENCV"}).encode()


def distortion_of_a_thin_prism() -> bytes:
    return json.dumps(cameras_document() | {"k1": 0.3, "s1": 0.01, "camera_model": "OPENCV"}).encode()


def label_out_of_the_codebook() -> bytes:
    by_view = {name: view.copy() for name, view in labels().items()}
    by_view["left"][0, 3, 3] = 3
    return pack(by_view)


def codebook_with_nan() -> bytes:
    rows = codebook().copy()
    rows[0, 0] = np.inf
    return pack(labels(), rows)


def mask_below_none() -> bytes:
    return masks({"left": np.full((2, 3), -2)})


def mask_of_fractions() -> bytes:
    return save({"left/mask": np.zeros((2, 3), np.float32)})


def no_masks() -> bytes:
    return save({"left": np.zeros((2, 3), np.int16)})


def table_with_a_word_too_many() -> bytes:
    return text_table(words=(*WORDS, "zeppelin"))


def table_of_zeros() -> bytes:
    return save({"embeddings": np.zeros((1, 8), np.float32)}, metadata={"words": '["apple"]'})


def table_that_is_masks_too() -> bytes:
    both = {"embeddings": codebook(), "left/mask": np.zeros((2, 3), np.int16)}
    return save(both, metadata={"words": json.dumps(WORDS)})


def half_a_surrogate_pair_in_a_word() -> bytes:
    return save({"embeddings": codebook()[:1]}, metadata={"words": '["\\ud800"]'})


def no_bytes() -> bytes:
    return b""


def garbage() -> bytes:
    return bytes(range(256)) * 40


BAD: list[tuple[str, Callable[[], bytes]]] = [
    ("splats", truncated_ply),
    ("splats", header_bomb),
    ("splats", counting_bomb),
    ("splats", splat_with_nan),
    ("splats", wrong_property),
    ("splats", empty_scene),
    ("splats", no_bytes),
    ("cameras", camera_without_pose),
    ("cameras", nameless_camera),
    ("cameras", camera_that_no_query_can_name),
    ("cameras", no_views),
    ("cameras", distortion_that_turns_back),
    ("cameras", distortion_of_a_thin_prism),
    ("cameras", garbage),
    ("features", label_out_of_the_codebook),
    ("features", codebook_with_nan),
    ("features", garbage),
    ("masks", mask_below_none),
    ("masks", mask_of_fractions),
    ("masks", no_masks),
    ("masks", garbage),
    ("table", table_with_a_word_too_many),
    ("table", table_of_zeros),
    ("table", table_that_is_masks_too),
    ("table", half_a_surrogate_pair_in_a_word),
    ("table", garbage),
]


# Each reader once through HTTP, which starts a process; the whole table goes through what that process runs.
OVER_HTTP = [
    ("splats", truncated_ply),
    ("cameras", camera_without_pose),
    ("features", label_out_of_the_codebook),
    ("masks", mask_below_none),
    ("table", half_a_surrogate_pair_in_a_word),
]


@pytest.mark.parametrize(("kind", "make"), OVER_HTTP, ids=[f"{kind}-{make.__name__}" for kind, make in OVER_HTTP])
def test_malformed_upload_is_refused_and_gone(
    client: TestClient, data: Path, kind: str, make: Callable[[], bytes]
) -> None:
    before = files_below(data)
    content = make()
    reply = client.put(f"/assets/{kind}", content=content)
    assert reply.status_code == 422, reply.text
    problem = reply.json()
    assert problem["type"] == f"/problems/invalid-{kind}"
    assert problem["expected"] and problem["got"]
    assert str(data) not in reply.text, "the server's paths are its own"
    assert files_below(data) == before
    digest = hashlib.sha256(content).hexdigest()
    assert client.get(f"/assets/sha256:{digest}").status_code == 404


@pytest.mark.parametrize(("kind", "make"), BAD, ids=[f"{kind}-{make.__name__}" for kind, make in BAD])
def test_every_malformed_file_is_told_in_one_line(tmp_path: Path, kind: str, make: Callable[[], bytes]) -> None:
    path = tmp_path / f"draft.{kind}"
    path.write_bytes(make())
    said = json.loads(json.dumps(check.run(kind, str(path)), allow_nan=False))
    assert said["event"] == "invalid"
    problem = problem_of(error_of(said["fault"]))
    assert (problem.status, problem.type) == (422, f"/problems/invalid-{kind}")
    assert problem.expected and problem.got and "\n" not in problem.detail
    assert str(tmp_path) not in problem.model_dump_json()


def test_names_of_cameras_are_as_long_as_a_query_may_say(tmp_path: Path) -> None:
    for image, said in (("a" * 500, None), ("a" * 501, "501: 'aaa"), ("", "an empty one")):
        path = tmp_path / "draft.cameras"
        path.write_bytes(camera_of(image))
        told = check.run(AssetKind.CAMERAS, str(path))
        assert told["event"] == ("valid" if said is None else "invalid")
        if said is not None:
            fault = told["fault"]
            assert (fault["argument"], fault["expected"]) == ("camera name", "1 to 500 characters")
            assert fault["got"].startswith(said) and len(fault["got"]) < 60


def test_upload_beyond_the_limit_is_413(client: TestClient, data: Path) -> None:
    before = files_below(data)
    reply = client.put("/assets/splats", content=b"ply\n" + b"\0" * 200_000)
    assert (reply.status_code, reply.json()["type"]) == (413, "/problems/too-large")
    assert files_below(data) == before


COMPRESS = {"gzip": gzip.compress, "zstd": zstandard.ZstdCompressor(level=19).compress}


@pytest.mark.parametrize("coding", COMPRESS)
def test_compressed_bomb_is_413(client: TestClient, data: Path, coding: str) -> None:
    before = files_below(data)
    bomb = COMPRESS[coding](b"\0" * 50_000_000)
    assert len(bomb) < 200_000
    reply = client.put("/assets/splats", content=bomb, headers={"Content-Encoding": coding})
    assert (reply.status_code, reply.json()["type"]) == (413, "/problems/too-large")
    assert files_below(data) == before


@pytest.mark.parametrize("coding", COMPRESS)
@pytest.mark.parametrize(
    "spoil",
    [
        lambda body: body[:-9],
        lambda body: b"no coding" + body,
        lambda body: body + b"garbage",
        lambda body: body + body[:-1],
        lambda _: b"",
    ],
    ids=["cut short", "garbage first", "garbage last", "second stream cut short", "empty"],
)
def test_broken_compression_is_refused(
    client: TestClient, data: Path, scene: TinyScene, spoil: Callable[[bytes], bytes], coding: str
) -> None:
    before = files_below(data)
    body = spoil(COMPRESS[coding](scene.splats))
    reply = client.put("/assets/splats", content=body, headers={"Content-Encoding": coding})
    assert (reply.status_code, reply.json()["type"]) == (422, "/problems/invalid-encoding")
    assert files_below(data) == before


@pytest.mark.parametrize("coding", ["br", "gzip, zstd", "nonsense"])
def test_other_codings_are_said_not_to_be_supported(client: TestClient, coding: str) -> None:
    reply = client.put("/assets/splats", content=b"...", headers={"Content-Encoding": coding})
    assert reply.status_code == 415
    assert coding in reply.json()["got"] and "gzip, zstd" in reply.json()["expected"]


def frame_with_window(log: int) -> bytes:
    """A zstd frame of one small block that asks for a window of 2^log bytes."""
    return b"\x28\xb5\x2f\xfd\x00" + bytes([(log - 10) << 3]) + (5 << 3 | 1).to_bytes(3, "little") + b"hello"


def test_window_of_a_zstd_frame_is_bounded() -> None:
    assert b"".join(Decoding(ZSTD).feed(frame_with_window(23))) == b"hello"
    for log in (24, 31, 41):
        with pytest.raises(InvalidEncoding) as refused:
            list(Decoding(ZSTD).feed(frame_with_window(log)))
        assert refused.value.got


@pytest.mark.parametrize("coding", [GZIP, ZSTD], ids=["gzip", "zstd"])
def test_what_comes_out_at_once_is_bounded_whatever_goes_in(coding: Coding) -> None:
    bomb = COMPRESS[coding.name](b"\0" * 200_000_000)
    assert max(len(content) for content in Decoding(coding).feed(bomb)) <= 17 << 20


@pytest.mark.parametrize("coding", [GZIP, ZSTD], ids=["gzip", "zstd"])
def test_streams_in_a_row_are_bounded(coding: Coding, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(intake, "MAX_MEMBERS", 50)
    body = COMPRESS[coding.name](b"")
    assert list(Decoding(coding).feed(body * 50))
    with pytest.raises(InvalidEncoding, match="at most 50"):
        list(Decoding(coding).feed(body * 51))


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
    rows = np.tile(splat_rows(), (20_000, 1))  # 67 MB, of which a reader holds several copies
    with start(check_memory_bytes=300 << 20) as client:
        small = client.put("/assets/splats", content=scene.splats)
        reply = client.put("/assets/splats", content=ply(rows))
    assert small.status_code == 201, small.text
    assert reply.status_code == 422, reply.text
