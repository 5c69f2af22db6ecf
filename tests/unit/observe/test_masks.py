"""Masks to judge by: what is read, and what is told of them."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import save_file

from liftcore.observe.inspect import inspect_file
from liftcore.observe.masks import read_masks


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
