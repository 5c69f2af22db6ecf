"""A lift in shards: a folder with X split by rows, and an index, for lifts too large for a single file.

The layout is that of sharded safetensors: ``lift.safetensors.index.json`` names the file of every tensor. X lies in
``features-00000.safetensors`` and so on, ROWS splats each, and the columns of the splats in ``columns.safetensors``.
A shard's rows begin at a page, and fill whole pages, so that all shards are mapped side by side: readers see one
array [P, F], as of one file, and nothing is gathered in memory.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liftcore.io.files import open_regular, whole_file
from liftcore.io.safetensors_file import (
    DTYPES,
    NO_RESERVE,
    map_over,
    map_tensors,
    safetensors_header,
    tensor_bytes,
    write_tensors,
)
from liftcore.runtime.mapping import map_anonymous

if TYPE_CHECKING:
    from torch import Tensor

SUFFIX = ".shards"  # of the folder's name
INDEX = "lift.safetensors.index.json"
COLUMNS = "columns.safetensors"
MAX_INDEX_BYTES = 64 << 20
ROWS = 1 << 17  # splats of a shard: with 512 channels of float16, 128 MiB
PAGE = 1 << 16  # bytes: the largest page of the machines that run this


class Shard(NamedTuple):
    """The rows of X that a file holds."""

    path: Path
    begin: int  # byte of the file
    shape: tuple[int, int]
    dtype: np.dtype


def features_file(number: int) -> str:
    """Return the name of a shard's file."""
    return f"features-{number:05}.safetensors"


def shards_of(splats: int, rows: int = ROWS) -> list[tuple[int, int]]:
    """Return (first, last + 1) splat of every shard."""
    return [(first, min(first + rows, splats)) for first in range(0, splats, rows)]


def write_rows(path: Path, features: Tensor) -> None:
    """Write one shard of X [n, F], whole or not at all; its rows begin at a page."""
    name = path.name.partition(".")[0]
    header, _ = safetensors_header([(name, features.dtype, tuple(features.shape))], {})
    text = header[8:] + b" " * (-len(header) % PAGE)
    with whole_file(path) as handle:
        handle.write(len(text).to_bytes(8, "little") + text)
        handle.write(tensor_bytes(features))


def write_index(folder: Path, columns: Mapping[str, Tensor], shards: int, metadata: str) -> None:
    """Write the columns and, last of all, the index, which makes a lift of the shards that lie there.

    Args:
        columns: whatever else a lift file has, by name. metadata: of the lift, as JSON.
    """
    write_tensors(folder / COLUMNS, columns, {})
    files = [features_file(number) for number in range(shards)]
    weight_map = {file.partition(".")[0]: file for file in files} | dict.fromkeys(columns, COLUMNS)
    total = sum((folder / file).stat().st_size for file in {*weight_map.values()})
    with whole_file(folder / INDEX) as handle:
        index = {"metadata": {"total_size": total, "splatlift": metadata}, "weight_map": weight_map}
        handle.write(json.dumps(index).encode())


def write_shards(folder: Path, tensors: Mapping[str, Tensor], metadata: str) -> None:
    """Write a lift's tensors in shards; the folder becomes a lift when all of them are there."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / INDEX).unlink(missing_ok=True)
    features = tensors["features"]
    bounds = shards_of(features.shape[0])
    for number, (first, last) in enumerate(bounds):
        write_rows(folder / features_file(number), features[first:last])
    columns = {name: tensor for name, tensor in tensors.items() if name != "features"}
    write_index(folder, columns, len(bounds), metadata)


def map_shards(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the tensors of a sharded lift, and its metadata, as `map_tensors` has those of one file."""
    with open_regular(folder / INDEX) as handle:
        content = handle.read(MAX_INDEX_BYTES + 1)
    if len(content) > MAX_INDEX_BYTES:
        raise ValueError(f"an index of more than {MAX_INDEX_BYTES} bytes")
    try:
        index = json.loads(content)
        metadata, weight_map = dict(index["metadata"]), dict(index["weight_map"])
        files = sorted({str(file) for file in weight_map.values()} - {COLUMNS})
    except (TypeError, KeyError, ValueError, RecursionError):
        raise ValueError("an index without metadata and weight_map") from None
    strangers = [file for file in files if Path(file).name != file]
    if strangers or files != [features_file(number) for number in range(len(files))] or not files:
        raise ValueError(f"an index of {strangers or files}"[:200])
    arrays, _ = map_tensors(folder / COLUMNS)
    return arrays | {"features": map_rows([shard_at(folder / file) for file in files])}, metadata


def shard_at(path: Path) -> Shard:
    """Read the header of a shard."""
    with open_regular(path) as handle:
        begin = 8 + int.from_bytes(handle.read(8), "little")
        if begin % PAGE or begin > 2 * PAGE:
            raise ValueError(f"{path.name} is no shard: its rows begin at byte {begin}")
        size = os.fstat(handle.fileno()).st_size
        try:
            entry = json.loads(handle.read(begin - 8))[path.name.partition(".")[0]]
            dtype, shape = np.dtype(DTYPES[entry["dtype"]]), tuple(entry["shape"])
        except (TypeError, KeyError, ValueError, RecursionError):
            raise ValueError(f"{path.name} is no shard: its header does not describe its rows") from None
    if not all(type(side) is int and side > 0 for side in shape):
        raise ValueError(f"{path.name} is no shard of rows: {shape}"[:160])
    if len(shape) != 2 or size != begin + shape[0] * shape[1] * dtype.itemsize:
        raise ValueError(f"{path.name} has {size} bytes, which are not {list(shape)} of {dtype}")
    return Shard(path, begin, shape, dtype)


def map_rows(shards: Sequence[Shard]) -> np.ndarray:
    """Return one array [P, F] over the rows of all shards, mapped; what is written into it stays in memory."""
    first = shards[0]
    sizes = [shard.shape[0] * shard.shape[1] * shard.dtype.itemsize for shard in shards]
    if any((shard.shape[1], shard.dtype) != (first.shape[1], first.dtype) for shard in shards):
        raise ValueError("shards of different channels or types")
    if any(size % PAGE for size in sizes[:-1]):
        raise ValueError("a shard that ends within a page, before the last")
    place, offset = map_anonymous(sum(sizes), NO_RESERVE), 0
    for shard, size in zip(shards, sizes, strict=True):
        with shard.path.open("rb") as handle:
            map_over(place, offset, handle, shard.begin, size)
        offset += size
    rows = sum(shard.shape[0] for shard in shards)
    return np.frombuffer(place, first.dtype).reshape(rows, first.shape[1])
