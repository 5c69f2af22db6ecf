"""Safetensors files written whole or not at all, their tensors one by one, with no copy in memory."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import torch

from liftcore.io.whole_file import whole_file

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from torch import Tensor

    Spec = tuple[str, torch.dtype, tuple[int, ...]]  # a tensor's name, type and shape

TYPES = {
    torch.float64: "F64",
    torch.int64: "I64",
    torch.float32: "F32",
    torch.int32: "I32",
    torch.float16: "F16",
    torch.int16: "I16",
    torch.bool: "BOOL",
}


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write tensors of any strides and place."""
    specs = [(name, tensor.dtype, tuple(tensor.shape)) for name, tensor in tensors.items()]
    header, offsets = safetensors_header(specs, metadata)
    with whole_file(path) as handle:
        handle.write(header)
        for name, offset in offsets.items():
            handle.seek(len(header) + offset)
            handle.write(tensor_bytes(tensors[name]))


def safetensors_header(specs: Iterable[Spec], metadata: Mapping[str, str]) -> tuple[bytes, dict[str, int]]:
    """The bytes before the first tensor, and where each tensor begins behind them."""
    header: dict[str, object] = {"__metadata__": dict(metadata)}
    offsets: dict[str, int] = {}
    end = 0
    # Wide types first keeps every tensor aligned to its own width, which a mapping needs.
    for key, dtype, shape in sorted(specs, key=lambda spec: -spec[1].itemsize):
        offsets[key] = end
        end += torch.Size(shape).numel() * dtype.itemsize
        header[key] = {"dtype": TYPES[dtype], "shape": shape, "data_offsets": (offsets[key], end)}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text, offsets


def tensor_bytes(tensor: Tensor) -> memoryview:
    """A tensor's bytes in row order, without a copy where it lies so already; from a card, if it lies there."""
    if not tensor.numel():  # an empty one of numpy's may have strides of zero, of which torch makes no bytes
        return memoryview(b"")
    return tensor.cpu().contiguous().flatten().view(torch.uint8).numpy().data
