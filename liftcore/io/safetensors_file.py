"""Safetensors files: checked before a reader parses them, mapped, and written atomically, without a copy in memory.

Torch is imported only where tensors are written, so that processes without it can read files.
"""

import ctypes
import json
import math
import mmap
import os
import struct
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from liftcore.io.files import first_bytes, open_regular, whole_file
from liftcore.runtime.memory import map_anonymous

NAMES = {
    "F64": "float64", "F32": "float32", "F16": "float16", "I64": "int64", "I32": "int32", "I16": "int16",
    "I8": "int8", "U8": "uint8", "U16": "uint16", "BOOL": "bool", "BF16": "V2",  # which NumPy has not: two bytes
}  # fmt: skip
TYPES = {f"torch.{name}": code for code, name in NAMES.items()}

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    Spec = tuple[str, torch.dtype, tuple[int, ...]]  # a tensor's name, type and shape

COPIED_BYTES = 1 << 20
NO_RESERVE = 0x4000 if sys.platform == "linux" else 0  # flags of mmap, which Python does not name
FIXED = 0x10
MAX_HEADER_BYTES = 32 * 1024 * 1024
_START = 9  # bytes: the header's length, and the brace that it begins with


def check_header(path: Path) -> None:
    """Refuse files that are no safetensors, headers of absurd length, and those with a name twice; a ValueError."""
    with open_regular(path) as handle:
        start = handle.read(_START)
        length = struct.unpack("<Q", start[:8])[0] if len(start) == _START else 0
        if len(start) < _START or start[8:] != b"{":
            got = f"a file that begins with {first_bytes(start)}" if start else "an empty file"
            raise ValueError(f"a safetensors file, got {got}")
        if length > MAX_HEADER_BYTES:
            raise ValueError(f"a header of at most {MAX_HEADER_BYTES} bytes, got {length} bytes")
        handle.seek(8)
        names: list[str] = []
        with suppress(ValueError, RecursionError):  # safetensors refuses bad JSON
            json.loads(handle.read(length), object_pairs_hook=lambda pairs: names.extend(_twice(pairs)))
    if names:  # readers differ in which of the two they take
        raise ValueError(f"a header that says each name once, got {names[0][:80]!r} twice")


def _twice(pairs: list[tuple[str, Any]]) -> list[str]:
    """Return the names that an object has twice."""
    names = [name for name, _ in pairs]
    return [name for name, count in Counter(names).items() if count > 1] if len({*names}) < len(names) else []


def write_tensors(path: Path, tensors: "Mapping[str, Tensor]", metadata: Mapping[str, str]) -> None:
    """Write tensors of any strides and device."""
    specs = [(name, tensor.dtype, tuple(tensor.shape)) for name, tensor in tensors.items()]
    header, offsets = safetensors_header(specs, metadata)
    with whole_file(path) as handle:
        handle.write(header)
        for name, offset in offsets.items():
            handle.seek(len(header) + offset)
            handle.write(tensor_bytes(tensors[name]))


def safetensors_header(specs: "Iterable[Spec]", metadata: Mapping[str, str]) -> tuple[bytes, dict[str, int]]:
    """Return the bytes before the first tensor, and the offset of each tensor behind them."""
    header: dict[str, object] = {"__metadata__": dict(metadata)}
    offsets: dict[str, int] = {}
    end = 0
    # Wide types first keeps every tensor aligned to its own width, which a mapping needs.
    for key, dtype, shape in sorted(specs, key=lambda spec: -spec[1].itemsize):
        offsets[key] = end
        end += math.prod(shape) * dtype.itemsize
        header[key] = {"dtype": TYPES[str(dtype)], "shape": shape, "data_offsets": (offsets[key], end)}
    return header_bytes(header), offsets


def header_bytes(header: Mapping[str, object]) -> bytes:
    """Encode a header as JSON after its length, padded so that tensors are aligned."""
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def with_metadata(path: Path | str, changes: Mapping[str, str]) -> Iterator[bytes]:
    """Yield the bytes of a safetensors file with changed metadata, in blocks; all else stays byte for byte."""
    with Path(path).open("rb") as handle:
        header = json.loads(handle.read(int.from_bytes(handle.read(8), "little")))
        header["__metadata__"] = (header.get("__metadata__") or {}) | dict(changes)
        yield header_bytes(header)
        while block := handle.read(COPIED_BYTES):
            yield block


def tensor_bytes(tensor: "Tensor") -> memoryview:
    """Return a tensor's bytes in row order, without a copy if it is contiguous in host memory."""
    import torch

    if not tensor.numel():  # an empty one of numpy's may have strides of zero, of which torch makes no bytes
        return memoryview(b"")
    flat = tensor.cpu().contiguous().flatten()
    return flat.as_strided(flat.shape, (1,)).view(torch.uint8).numpy().data  # a single number may have any stride


def map_tensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the tensors of a safetensors file, and its metadata.

    The mapping is private: what a caller writes into an array stays in memory.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="np") as handle:  # which validates the header
            metadata = handle.metadata() or {}
    except SafetensorError as error:
        raise ValueError(str(error)[:160]) from None
    with path.open("rb") as file:
        start = 8 + int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(start - 8))
        mapped = map_file(file)
    return {name: _array(mapped, start, entry) for name, entry in header.items() if name != "__metadata__"}, metadata


def check_arrays(arrays: Mapping[str, np.ndarray], schema: Mapping[str, tuple[str, str]]) -> dict[str, int]:
    """Return the length of each axis of arrays that have the types and axes of a schema; a ValueError names others.

    Args:
        schema: name -> types as NumPy has them, and letters of axes, such as ("f2 f4", "P F"); equal letters are
        equally long in all arrays. Names that are missing are not checked.
    """
    lengths: dict[str, int] = {}
    for name, (types, axes) in schema.items():
        array, letters = arrays.get(name), axes.split()
        if array is None:
            continue
        fits = array.ndim == len(letters) and array.dtype in [np.dtype(code) for code in types.split()]
        sides = dict(zip(letters, array.shape, strict=fits))
        if not fits or any(lengths.setdefault(letter, side) != side for letter, side in sides.items()):
            known_sides = "".join(f", {letter} = {side}" for letter, side in lengths.items() if letter in letters)
            raise ValueError(f"{name} {types} [{axes}]{known_sides}, got {array.dtype} {list(array.shape)}")
    return lengths


def map_file(file: IO[bytes]) -> mmap.mmap:
    """Map a whole file privately, without keeping it open as Python's own maps do: there may be thousands."""
    if sys.platform == "win32":
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    size = os.fstat(file.fileno()).st_size
    place = map_anonymous(size, NO_RESERVE)
    address = ctypes.addressof(ctypes.c_char.from_buffer(place))
    system = ctypes.CDLL(None, use_errno=True)
    system.mmap.restype = ctypes.c_void_p
    system.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    flags = mmap.MAP_PRIVATE | FIXED | NO_RESERVE
    if system.mmap(address, size, mmap.PROT_READ | mmap.PROT_WRITE, flags, file.fileno(), 0) != address:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), file.name)
    return place


def _array(mapped: mmap.mmap, start: int, entry: dict) -> np.ndarray:
    if entry["dtype"] not in NAMES:
        raise ValueError(f"tensors of the type {entry['dtype']}")
    dtype, count = np.dtype(NAMES[entry["dtype"]]), math.prod(entry["shape"])
    if count == 0:
        return np.empty(entry["shape"], dtype)
    array = np.frombuffer(mapped, dtype, count, start + entry["data_offsets"][0]).reshape(entry["shape"])
    return np.require(array, requirements="A")  # a copy where the file was not aligned
