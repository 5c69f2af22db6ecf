"""Splat files of editors and trainers: read as their own tools read them, within limits, and exported row by row.

``tests/data/splats`` holds seeded scenes of 300 splats (degree 1, two chunks) and 40 (degree 3) that splat-transform
2.7.1 wrote, the ``.splat`` and the ``.spz`` of versions 1 and 2 apart, which it only reads. Each lies beside the PLY
that splat-transform makes of it.
"""

from __future__ import annotations

import gzip
import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import zstandard

from liftcore.errors import InvalidSplats
from liftcore.io.kinds import SplatFormat, kind_of
from liftcore.io.quantised import LEAST_ALPHA
from liftcore.io.splats import (
    format_of,
    read_places,
    read_splats,
    recoloured,
    require_kernel,
    some_rows,
    splat_files,
    write_splats,
)
from liftcore.io.spz import FRAME_EXTENSION, FRAMES, RDF, spz_blocks
from liftcore.query.splat_colours import _sh_basis
from liftcore.scene.harmonics import band_rotation, band_values, constant_terms
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from liftcore.values.lift_file import input_file
from tests.scenes import random_splats

FILES = Path(__file__).parents[2] / "data" / "splats"
FORMATS = {
    "degree1.compressed.ply": SplatFormat.COMPRESSED_PLY,
    "degree1.sog": SplatFormat.SOG,
    "degree3.compressed.ply": SplatFormat.COMPRESSED_PLY,
    "degree3.sog": SplatFormat.SOG,
    "degree3.splat": SplatFormat.SPLAT,
    "degree3.streamed.zip": SplatFormat.STREAMED_SOG,
    **{f"degree3.v{version}.spz": SplatFormat.SPZ for version in (1, 2, 3, 4)},
}
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")
HIGHEST = float(np.log((1 - LEAST_ALPHA) / LEAST_ALPHA))


def assert_alike(actual: Splats, expected: Splats) -> None:
    assert torch.allclose(actual.means, expected.means, atol=1e-6)
    assert torch.allclose(actual.log_scales, expected.log_scales, atol=1e-6)
    cosines = (torch.nn.functional.normalize(actual.quats) * torch.nn.functional.normalize(expected.quats)).sum(dim=1)
    assert torch.allclose(cosines.abs(), torch.ones(actual.count), atol=2e-4)  # .splat's zero is read as 127.5 or 128
    clamped = expected.opacity_logits.clamp(-HIGHEST, HIGHEST)  # infinite in some of splat-transform's
    assert torch.allclose(actual.opacity_logits, clamped, atol=1e-4)
    assert actual.sh is not None and expected.sh is not None and actual.sh.shape == expected.sh.shape
    assert torch.allclose(actual.sh, expected.sh, atol=1e-6)


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_read_as_its_own_tool_reads_it(name: str, tmp_path: Path) -> None:
    expected = read_splats(FILES / f"{name}.decoded.ply")
    unnamed = tmp_path / "upload"
    unnamed.write_bytes((FILES / name).read_bytes())
    for path in (FILES / name, unnamed):
        assert format_of(path) is FORMATS[name]
        assert_alike(read_splats(path), expected)
    document = {SplatFormat.SOG: "meta.json", SplatFormat.STREAMED_SOG: "lod-meta.json"}.get(FORMATS[name])
    if document is not None:  # whose files may lie in a folder
        with zipfile.ZipFile(FILES / name) as archive:
            archive.extractall(tmp_path / "folder")
        for path in (tmp_path / "folder", tmp_path / "folder" / document):
            assert kind_of(path) == "splats" and format_of(path) is FORMATS[name]
            assert_alike(read_splats(path), expected)
        before = input_file(tmp_path / "folder").sha256
        (tmp_path / "folder" / "others").mkdir()  # which are none of it
        assert input_file(tmp_path / "folder").sha256 == before
        parts = splat_files(tmp_path / "folder")
        assert tmp_path / "folder" / document in parts and len(parts) > 4
        (tmp_path / "folder" / "others" / "more.json").write_text("{}")
        assert splat_files(tmp_path / "folder") == parts
        (tmp_path / "folder" / document).write_text("{}")
        assert input_file(tmp_path / "folder").sha256 != before
    bare, full = read_splats(unnamed, colour=False), read_splats(unnamed)
    assert bare.sh is None and torch.equal(bare.means, full.means) and torch.equal(bare.quats, full.quats)
    assert np.array_equal(read_places(unnamed), full.means.numpy())
    assert np.array_equal(read_places(FILES / f"{name}.decoded.ply"), expected.means.numpy())


def test_the_finest_level_of_each_leaf_of_a_streamed_sog_is_one_scene(tmp_path: Path) -> None:
    for name in ("degree1.sog", "degree3.sog"):
        with zipfile.ZipFile(FILES / name) as archive:
            archive.extractall(tmp_path / name.removesuffix(".sog"))
    fine, coarse = read_splats(FILES / "degree1.sog"), read_splats(FILES / "degree3.sog")

    def leaf(**levels: tuple[int, int, int]) -> dict[str, Any]:
        rows = {
            level[1:]: dict(zip(("file", "offset", "count"), numbers, strict=True))
            for level, numbers in levels.items()
        }
        return {"lods": rows}

    def read(
        *leaves: dict[str, Any], names: Any = ("degree3/meta.json", "degree1/meta.json"), **fields: Any
    ) -> Splats:
        document = {"filenames": names, "tree": {"children": [{"children": leaves[:1]}, *leaves[1:]]}, **fields}
        (tmp_path / "lod-meta.json").write_text(json.dumps(document))
        return read_splats(tmp_path / "lod-meta.json")

    splats = read(leaf(_1=(0, 9, 5), _0=(1, 200, 100)), leaf(_2=(0, 30, 10)), leaf(_0=(1, 0, 40)), environment="env")
    assert torch.equal(splats.means, torch.cat([coarse.means[30:], fine.means[:40], fine.means[200:]]))
    assert splats.sh is not None and splats.sh_degree == 3 and not splats.sh[10:, 4:].any()
    assert any("environment" in warning for warning in splats.warnings)
    wrong: dict[str, tuple[tuple[Any, ...], dict[str, Any]]] = {
        "rows of their own": ((leaf(_0=(1, 0, 40)), leaf(_0=(1, 39, 2))), {}),
        "rows within the 300": ((leaf(_0=(1, 0, 301)),), {}),
        "one of 2 files": ((leaf(_0=(2, 0, 1)),), {}),
        "levels of detail": ((leaf(_x=(0, 0, 1)),), {}),
        "none that a leaf has": ((leaf(),), {}),
        "nodes that are objects": (([],), {}),
        "each once": ((leaf(_0=(0, 0, 1)), leaf(_0=(1, 0, 1))), {"names": ["degree1/meta.json"] * 2}),
        "beside it": ((leaf(_0=(0, 0, 1)),), {"names": ["none/meta.json"]}),
    }
    outside = (
        "../degree1/meta.json",
        "/etc/meta.json",
        "https://a/meta.json",
        "degree1/./meta.json",
        "a\\meta.json",
        7,
    )
    wrong |= {
        f"in the folder.*{number}": ((leaf(_0=(0, 0, 1)),), {"names": [path]}) for number, path in enumerate(outside)
    }
    for match, (leaves, fields) in wrong.items():
        with pytest.raises(InvalidSplats, match=match.split(".*")[0]):
            read(*leaves, **fields)


@pytest.mark.parametrize("name", FORMATS)
def test_exports_of_every_format_are_plys_of_the_same_rows(name: str, tmp_path: Path) -> None:
    full = read_splats(FILES / name)
    mask = np.arange(full.count) % 3 == 1
    (tmp_path / "some.ply").write_bytes(b"".join(some_rows(FILES / name, mask)))
    subset = read_splats(tmp_path / "some.ply")
    for field in FIELDS:
        assert torch.equal(getattr(subset, field), getattr(full, field)[torch.from_numpy(mask)])
    colours = np.random.default_rng(0).integers(0, 256, (full.count, 3)).astype(np.uint8)
    (tmp_path / "coloured.ply").write_bytes(b"".join(recoloured(FILES / name, colours)))
    coloured = read_splats(tmp_path / "coloured.ply")
    terms = torch.from_numpy(constant_terms(colours / 255).astype(np.float32))
    assert coloured.sh is not None and torch.equal(coloured.sh[:, 0], terms)
    assert torch.equal(coloured.means, full.means)
    with pytest.raises(InvalidSplats, match=f"as many as were lifted, got {full.count}"):
        list(some_rows(FILES / name, mask[:-1]))


@pytest.mark.parametrize("name", FORMATS)
def test_damage_of_any_kind_is_splats_or_an_error_of_ours(name: str, tmp_path: Path) -> None:
    content, path, random = (FILES / name).read_bytes(), tmp_path / "damaged", np.random.default_rng(1)
    damaged = [content[:cut] for cut in random.integers(0, len(content), 25)]
    for _ in range(60):
        copy = bytearray(content)
        for place in random.integers(0, min(len(content), 2000), 3):
            copy[place] = random.integers(256)
        damaged.append(bytes(copy))
    for variant in damaged:
        path.write_bytes(variant)
        try:
            assert read_splats(path).count > 0
        except InvalidSplats as error:
            assert "\n" not in str(error) and len(str(error)) < 700


def spz_header(version: int, count: int, streams: int = 0) -> bytes:
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, 0, 12, 0, streams)


def bomb(kind: str, path: Path) -> None:
    """Write a small file whose header declares a large one."""
    if kind == "spz 4":
        sizes = [9, 1, 3, 3, 4]
        stream = zstandard.ZstdCompressor().compress(bytes(10_000_000))
        table = b"".join(struct.pack("<QQ", len(stream), 100 * size) for size in sizes)
        path.write_bytes(spz_header(4, 100, 5) + struct.pack("<I12x", 32) + table + stream * 5)
    elif kind == "spz 4 of many":
        path.write_bytes(spz_header(4, 1 << 30, 5) + struct.pack("<I12x", 32))
    elif kind == "spz 3":
        import gzip

        path.write_bytes(gzip.compress(spz_header(3, 1 << 30) + bytes(1000)))
    elif kind == "sog":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("meta.json", json.dumps({"version": 2, "count": 1 << 40}))
    elif kind == "sog of zeros":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            part = {"files": ["zeros.webp", "zeros.webp"], "mins": [0] * 3, "maxs": [1] * 3}
            archive.writestr("meta.json", json.dumps({"version": 2, "count": 4, "means": part}))
            archive.writestr("zeros.webp", bytes(10_000_000))
    else:
        head = (FILES / "degree3.compressed.ply").read_bytes()
        path.write_bytes(head.replace(b"element vertex 40", b"element vertex 99999999999"))


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("spz 4", "a stream of 900 bytes"),
        ("spz 4 of many", "as many splats as the file's size can be of, got 1073741824 in"),
        ("spz 3", "as many splats as the file's size can be of, got 1073741824 in"),
        ("sog", "a count of splats that the file's size can be of, got 1099511627776"),
        ("sog of zeros", "bytes of 'zeros.webp', got more"),
        ("compressed PLY", "bytes, as its header says"),
    ],
)
def test_small_files_that_say_they_are_large_are_refused(kind: str, message: str, tmp_path: Path) -> None:
    bomb(kind, tmp_path / "bomb")
    with pytest.raises(InvalidSplats, match=message):
        read_splats(tmp_path / "bomb")


@pytest.mark.parametrize(
    ("part", "key", "value", "message"),
    [
        ("", "version", 1, "version 2, got 1"),
        ("", "count", 400, "400 pixels in 'means_l.webp'"),
        ("", "means", None, "'means' in meta.json, got none"),
        ("means", "maxs", [1e6] * 3, "at least one splat of finite numbers"),
        ("means", "mins", [float("nan")] * 3, "3 finite numbers as 'mins' of 'means'"),
        ("means", "files", ["../x", "y"], r"'\.\./x' beside meta.json, got none"),
        ("scales", "codebook", [0.0] * 255, "256 finite numbers as 'codebook' of 'scales'"),
        ("sh0", "files", ["meta.json"], "a WebP picture as 'meta.json'"),
        ("shN", "count", 1, "labels below 1"),
        ("shN", "bands", 2, "a palette 512 pixels wide, got 960"),
        ("", "", None, "meta.json as JSON"),
    ],
)
def test_sog_that_says_something_else_is_refused(
    part: str, key: str, value: Any, message: str, tmp_path: Path
) -> None:
    with zipfile.ZipFile(FILES / "degree3.sog") as archive, zipfile.ZipFile(tmp_path / "a", "w") as output:
        for name in archive.namelist():
            content = archive.read(name)
            if name == "meta.json":
                meta = json.loads(content)
                (meta[part] if part else meta)[key] = value
                content = json.dumps(meta).encode() if key else b"{"
            output.writestr(name, content)
    with pytest.raises(InvalidSplats, match=message):
        read_splats(tmp_path / "a")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"float min_x", b"float mon_x", "the float 'min_x' of the element 'chunk', got none"),
        (b"uint packed_color", b"uint packed_colur", "the uint 'packed_color' of the element 'vertex'"),
        (b"uchar f_rest_44", b"uchar f_rest_45", "9 or 24 or 45 uchar f_rest"),
        (b"element chunk 1", b"element chunk 2", "bytes, as its header says, got"),
    ],
)
def test_compressed_ply_that_lacks_something_is_refused(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    head, end, body = (FILES / "degree3.compressed.ply").read_bytes().partition(b"end_header\n")
    assert old in head
    (tmp_path / "a").write_bytes(head.replace(old, new) + end + body)
    with pytest.raises(InvalidSplats, match=message):
        read_splats(tmp_path / "a")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.splat", bytes(33), "rows of 32 bytes, got 33 bytes"),
        ("a.splat", b"", "an empty file"),
        ("a.ksplat", bytes(64), r"GaussianSplats3D's \.ksplat format; .*splat-transform"),
        ("a", b"NGSP\x09\0\0\0" + bytes(40), r"an \.spz of version 1 to 4, got version 9"),
        ("a.spz", b"\x1f\x8b\x08", "a gzip file"),
        ("a.ckpt", b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        ("a.pt", b"\x80\x02}q\0.", "a Python pickle, which may run code"),
    ],
)
def test_what_is_none_of_the_formats_is_named(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InvalidSplats, match=message):
        read_splats(tmp_path / name)


def test_the_frame_that_an_spz_declares_is_its_own(tmp_path: Path) -> None:
    content = (FILES / "degree3.v4.spz").read_bytes()
    extensions = struct.pack("<III", FRAME_EXTENSION, 4, RDF) + struct.pack("<II3x", 0x12340001, 3)
    place = struct.pack("<I", 32 + len(extensions))
    (tmp_path / "declared.spz").write_bytes(content[:16] + place + content[20:32] + extensions + content[32:])
    actual, stored = read_splats(tmp_path / "declared.spz"), read_splats(FILES / "degree3.v4.spz")
    assert torch.equal(actual.means, stored.means * torch.tensor([1.0, -1.0, -1.0]))
    assert torch.allclose(actual.quats, stored.quats * torch.tensor([1.0, 1.0, -1.0, -1.0]))
    assert actual.sh is not None and stored.sh is not None
    assert torch.allclose(actual.sh[:, 1:4], stored.sh[:, 1:4] * torch.tensor([-1.0, -1.0, 1.0])[:, None])


LETTERS = {"R": (0, 1), "L": (0, -1), "D": (1, 1), "U": (1, -1), "F": (2, 1), "B": (2, -1)}  # axis and sign in RDF


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("number", range(1, 17))
def test_every_frame_that_an_spz_may_declare_is_turned_by_its_letters(
    number: int, version: int, tmp_path: Path
) -> None:
    """Positions, covariances and colours from all directions are the file's, in the axes that its letters name."""
    content, extension = (FILES / f"degree3.v{version}.spz").read_bytes(), struct.pack("<III", FRAME_EXTENSION, 4, 0)
    frame_bytes = extension[:8] + struct.pack("<I", number)
    if version == 4:
        place = struct.pack("<I", 32 + len(frame_bytes))
        content = content[:16] + place + content[20:32] + frame_bytes + content[32:]
    else:
        payload = gzip.decompress(content)
        content = gzip.compress(payload[:14] + b"\x02" + payload[15:] + frame_bytes)
    (tmp_path / "a.spz").write_bytes(content)
    actual, stored = read_splats(tmp_path / "a.spz"), read_splats(FILES / f"degree3.v{version}.spz")
    axes = np.zeros((3, 3))  # from the frame to RDF
    for column, letter in enumerate(FRAMES[number - 1]):
        axis, sign = LETTERS[letter]
        axes[axis, column] = sign
    axes = axes @ np.diag([1.0, -1.0, -1.0])  # from RDF as that is read from RUB, which stands for the stored numbers
    np.testing.assert_allclose(actual.means.numpy(), stored.means.numpy() @ axes.T, atol=1e-5)
    assert torch.equal(actual.log_scales, stored.log_scales)
    np.testing.assert_allclose(covariances(actual), axes @ covariances(stored) @ axes.T, atol=1e-5)
    directions = np.random.default_rng(0).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(radiance(actual, directions), radiance(stored, directions @ axes), atol=1e-4)


def covariances(splats: Splats) -> np.ndarray:
    w, x, y, z = torch.nn.functional.normalize(splats.quats.double(), dim=1).numpy().T
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    half = np.stack(rows, axis=1).reshape(-1, 3, 3) * np.exp(splats.log_scales.double().numpy())[:, None]
    return half @ half.transpose(0, 2, 1)


def radiance(splats: Splats, directions: np.ndarray) -> np.ndarray:
    """Return the harmonics [n, P, 3] of all splats along directions, in the renderer's basis."""
    assert splats.sh is not None
    basis = _sh_basis(torch.from_numpy(directions).float(), 3)
    return torch.einsum("nk,pkc->npc", basis, splats.sh).numpy()


@pytest.mark.parametrize("band", range(5))
def test_rotations_of_a_band_turn_what_it_shows(band: int) -> None:
    generator = np.random.default_rng(band)
    rotation = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    directions = generator.normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    terms = generator.normal(size=2 * band + 1)
    values = band_values(band, directions) @ band_rotation(band, rotation) @ terms
    np.testing.assert_allclose(values, band_values(band, directions @ rotation) @ terms, atol=1e-9)
    if band < 4:
        expected = _sh_basis(torch.from_numpy(directions), 3)[:, band**2 : (band + 1) ** 2]
        np.testing.assert_allclose(band_values(band, directions), expected, atol=1e-6)


def test_a_frame_beyond_those_is_refused(tmp_path: Path) -> None:
    content = gzip.decompress((FILES / "degree3.v3.spz").read_bytes())
    content = content[:14] + b"\x02" + content[15:] + struct.pack("<III", FRAME_EXTENSION, 4, 17)
    (tmp_path / "a.spz").write_bytes(gzip.compress(content))
    with pytest.raises(InvalidSplats, match="one of the 16 frames of the format, got frame 17"):
        read_splats(tmp_path / "a.spz")


def trained() -> Splats:
    return read_splats(FILES / "degree3.sog.decoded.ply")


def gsplat_checkpoint(splats: Splats) -> dict[str, Any]:
    assert splats.sh is not None
    tensors = {"means": splats.means, "quats": splats.quats, "scales": splats.log_scales}
    tensors |= {"opacities": splats.opacity_logits, "sh0": splats.sh[:, :1], "shN": splats.sh[:, 1:]}
    return {"step": 6999, "splats": {name: torch.nn.Parameter(value) for name, value in tensors.items()}}


def nerfstudio_checkpoint(splats: Splats, before: str) -> dict[str, Any]:
    assert splats.sh is not None
    tensors = {"means": splats.means, "quats": splats.quats, "scales": splats.log_scales}
    tensors |= {"opacities": splats.opacity_logits[:, None], "features_dc": splats.sh[:, 0]}
    tensors |= {"features_rest": splats.sh[:, 1:], "other": torch.zeros(1)}
    rates = {
        "_last_lr": [np.float64(1e-4), np.float32(1e-3)],
        "last_epoch": np.int64(7),
    }  # as its schedulers have them
    pipeline = {f"{before}{name}": value for name, value in tensors.items()}
    return {"step": 1, "pipeline": pipeline, "schedulers": {"means": rates}}


@pytest.mark.parametrize("kind", ["gsplat", "_model.gauss_params.", "_model."])
def test_checkpoints_of_trainers_are_read_as_tensors(kind: str, tmp_path: Path) -> None:
    splats, path = trained(), tmp_path / "step-000029999.ckpt"
    torch.save(gsplat_checkpoint(splats) if kind == "gsplat" else nerfstudio_checkpoint(splats, kind), path)
    assert format_of(path) is SplatFormat.CHECKPOINT
    actual = read_splats(path)
    for field in FIELDS:
        assert torch.equal(getattr(actual, field), getattr(splats, field))
    write_splats(tmp_path / "again.ply", actual)
    assert torch.equal(read_splats(tmp_path / "again.ply").means, splats.means)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"splats": {"means": Path("code")}}, "holds more than tensors, or is damaged .*ns-export"),
        ({"model": {"weight": torch.zeros(2)}}, "the splats of gsplat .* got a checkpoint of 'model'"),
        ([torch.zeros(2)], "got a checkpoint of list"),
        ({"splats": {"means": torch.zeros(2, 3)}}, "quats: expected floats, a row a splat, got none"),
        ({"splats": {"means": torch.zeros(1).expand(1 << 30, 3)}}, "not stored completely"),
        ({"splats": {"means": torch.eye(3).to_sparse()}}, "not stored completely"),
        ({"splats": {"means": torch.zeros(1 << 20, 3, device="meta")}}, "not stored completely|damaged"),
        ({"splats": {"means": torch.zeros(2, 3, dtype=torch.int32)}}, r"means: expected floats.*int32 \[2, 3\]"),
    ],
)
def test_checkpoints_of_other_things_are_refused_and_run_nothing(content: Any, message: str, tmp_path: Path) -> None:
    torch.save(content, tmp_path / "c.pt")
    with pytest.raises(InvalidSplats, match=message):
        read_splats(tmp_path / "c.pt")


def test_kernels_of_formats_without_columns_are_3dgs_or_2dgs() -> None:
    path = FILES / "degree3.splat"
    flat = read_splats(path, "2dgs")
    assert (read_splats(path).kernel, flat.kernel) == (Kernel.GAUSSIAN_3D, Kernel.GAUSSIAN_2D)
    assert flat.log_scales.shape == (40, 2)
    with pytest.raises(InvalidSplats, match=r"the property 'beta' of a dbs splat, got \.splat, which has none"):
        read_splats(path, "dbs")
    with pytest.raises(InvalidSplats, match=r"asset: expected the property 'beta'"):
        require_kernel(path, Kernel.BETA, "asset")


@pytest.mark.parametrize("name", FORMATS)
def test_large_files_are_decoded_in_blocks_to_the_same_rows(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = read_splats(FILES / name)
    monkeypatch.setattr("liftcore.io.quantised.BLOCK_ROWS", 7)
    actual = read_splats(FILES / name)
    for field in FIELDS:
        assert torch.equal(getattr(actual, field), getattr(expected, field))


@pytest.mark.parametrize("version", [2, 3])
def test_an_spz_that_we_write_is_read_as_the_file_that_it_is_of(version: int, tmp_path: Path) -> None:
    splats = read_splats(FILES / f"degree3.v{version}.spz")
    (tmp_path / "again.spz").write_bytes(b"".join(spz_blocks(splats)))
    copy = read_splats(tmp_path / "again.spz")
    products = copy.quats * torch.nn.functional.normalize(splats.quats, dim=1)
    assert float(products.sum(dim=1).abs().min()) > 0.99999
    for field, tolerance in (("means", 1e-6), ("log_scales", 1e-6), ("sh", 1e-6)):
        assert torch.allclose(getattr(copy, field), getattr(splats, field), atol=tolerance), field
    assert torch.allclose(copy.opacity_logits.sigmoid(), splats.opacity_logits.sigmoid(), atol=1e-6)


def test_random_bytes_are_no_splats(tmp_path: Path) -> None:
    for seed in range(20):
        (tmp_path / "noise").write_bytes(np.random.default_rng(seed).bytes(32 * 200))
        with pytest.raises(InvalidSplats, match=r"begins with|gzip|pickle"):
            read_splats(tmp_path / "noise")
    write_splats(tmp_path / "noise", random_splats(1, 20))  # a PLY of any name stays one
    assert format_of(tmp_path / "noise") is SplatFormat.PLY
