"""Splat files of editors and trainers: read as their own tools read them, within limits, and exported row by row.

``tests/data/splats`` holds seeded scenes of 300 splats (degree 1, two chunks) and 40 (degree 3) that splat-transform
2.7.1 wrote, the ``.splat`` and the ``.spz`` of versions 1 and 2 apart, which it only reads. Each lies beside the PLY
that splat-transform makes of it.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidSplats
from liftcore.io.formats import SplatFormat
from liftcore.io.splats import read_splats, recoloured, some_rows
from liftcore.io.spz import FRAME_EXTENSION, FRAMES
from liftcore.query.splat_colours import _sh_basis
from liftcore.scene.harmonics import band_rotation, band_values, constant_terms
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats

FILES = Path(__file__).parents[2] / "data" / "splats"
FORMATS = {
    "degree1.compressed.ply": SplatFormat.COMPRESSED_PLY,
    "degree1.sog": SplatFormat.SOG,
    "degree3.compressed.ply": SplatFormat.COMPRESSED_PLY,
    "degree3.sog": SplatFormat.SOG,
    "degree3.splat": SplatFormat.SPLAT,
    **{f"degree3.v{version}.spz": SplatFormat.SPZ for version in (1, 2, 3, 4)},
}
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


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


LETTERS = {"R": (0, 1), "L": (0, -1), "D": (1, 1), "U": (1, -1), "F": (2, 1), "B": (2, -1)}  # axis and sign in RDF


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("number", range(1, 9))
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
    content = content[:14] + b"\x02" + content[15:] + struct.pack("<III", FRAME_EXTENSION, 4, 9)
    (tmp_path / "a.spz").write_bytes(gzip.compress(content))
    with pytest.raises(InvalidSplats, match="one of the 8 frames of the format, got frame 9"):
        read_splats(tmp_path / "a.spz")


def test_kernels_of_formats_without_columns_are_3dgs_or_2dgs() -> None:
    path = FILES / "degree3.splat"
    flat = read_splats(path, "2dgs")
    assert (read_splats(path).kernel, flat.kernel) == (Kernel.GAUSSIAN_3D, Kernel.GAUSSIAN_2D)
    assert flat.log_scales.shape == (40, 2)
    with pytest.raises(InvalidSplats, match=r"the property 'beta' of a dbs splat, got \.splat, which has none"):
        read_splats(path, "dbs")


@pytest.mark.parametrize("name", FORMATS)
def test_large_files_are_decoded_in_blocks_to_the_same_rows(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = read_splats(FILES / name)
    monkeypatch.setattr("liftcore.io.quantised.BLOCK_ROWS", 7)
    actual = read_splats(FILES / name)
    for field in FIELDS:
        assert torch.equal(getattr(actual, field), getattr(expected, field))
