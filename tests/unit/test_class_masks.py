"""Masks to judge by: what is read, and what is told of them."""

from __future__ import annotations

import struct

import pytest
import torch
from safetensors.torch import save_file

from liftcore.io.class_masks import read_masks
from liftcore.io.inspect import inspect_file


def test_masks_of_any_integers_are_read_and_described(tmp_path):
    stored = {
        "b/mask": torch.tensor([[255, 7, 0]], dtype=torch.uint8),  # 255 is none, as in feature packs
        "a/mask": torch.tensor([[-1], [3]], dtype=torch.int8),
        "c/mask": torch.full((2, 2), -1),
        "c/other": torch.zeros(1),
    }
    save_file(stored, tmp_path / "m.safetensors")
    read = read_masks(tmp_path / "m.safetensors", 8)
    assert {view: mask.tolist() for view, mask in read.items()} == {
        "a": [[-1], [3]], "b": [[-1, 7, 0]], "c": [[-1, -1], [-1, -1]],
    }  # fmt: skip
    told = inspect_file(tmp_path / "m.safetensors")
    assert (told["kind"], told["views"], told["names"], told["classes"]) == ("masks", 3, ["a", "b", "c"], 8)
    assert (told["sizes"], told["unlabelled"]) == (["1x2", "2x2", "3x1"], pytest.approx((1 / 2 + 1 / 3 + 1) / 3))
    assert told["warnings"] == ["1 of 3 masks name no class"]


@pytest.mark.parametrize("length", [640, 640 + (1 << 16), 19_280])  # as numbers they begin as pickles and zips do
def test_a_header_as_long_as_a_signature_reads_is_a_header(length, tmp_path):
    path = tmp_path / "m.safetensors"
    save_file({"a/mask": torch.tensor([[0, 1]])}, path)
    content = path.read_bytes()
    (own,) = struct.unpack("<Q", content[:8])
    header = content[8 : 8 + own].rstrip()
    path.write_bytes(struct.pack("<Q", length) + header.ljust(length) + content[8 + own :])
    assert path.read_bytes()[:2] in (b"PK", b"\x80\x02")
    assert read_masks(path, 2)["a"].tolist() == [[0, 1]]
