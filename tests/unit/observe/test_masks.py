"""Masks to judge by: what is read, and what is told of them."""

from __future__ import annotations

import torch
from safetensors.torch import save_file

from liftcore.observe.inspect import inspect_file
from liftcore.observe.masks import read_masks


def test_masks_of_any_integers_are_read_and_described(tmp_path):
    stored = {
        "b/mask": torch.tensor([[255, 0]], dtype=torch.uint8),  # a number like any other
        "a/mask": torch.tensor([[-1], [3]], dtype=torch.int8),
        "c/mask": torch.full((2, 2), -1),
        "c/other": torch.zeros(1),
    }
    save_file(stored, tmp_path / "m.safetensors")
    read = read_masks(tmp_path / "m.safetensors", 256)
    assert {view: mask.tolist() for view, mask in read.items()} == {
        "a": [[-1], [3]], "b": [[255, 0]], "c": [[-1, -1], [-1, -1]],
    }  # fmt: skip
    told = inspect_file(tmp_path / "m.safetensors")
    assert (told["kind"], told["views"], told["names"], told["classes"]) == ("masks", 3, ["a", "b", "c"], 256)
    assert (told["sizes"], told["unlabelled"]) == (["1x2", "2x1", "2x2"], 0.5)
    assert told["warnings"] == ["1 of 3 masks name no class"]
