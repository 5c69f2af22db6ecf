"""Where W lives between geometry and solution: in memory while it is small, in mapped files beyond that."""

from __future__ import annotations

import tempfile
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
import torch

from liftcore.raster.protocol import RegionWeights

if TYPE_CHECKING:
    from collections.abc import Iterator

MEMORY_LIMIT = 1 << 30  # bytes of W that stay in memory; later views go to files


class ViewWeights:
    """The region weights of every view, in view order. A context manager: leaving it removes the files.

    Args:
        memory_limit: bytes that stay in memory; None takes MEMORY_LIMIT.
    """

    def __init__(self, memory_limit: int | None = None) -> None:
        self._limit = MEMORY_LIMIT if memory_limit is None else memory_limit
        self._views: list[RegionWeights] = []
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.bytes = 0  # in memory and in files
        self.mapped_bytes = 0  # in files

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._views.clear()
        if self._folder is not None:
            self._folder.cleanup()

    def append(self, weights: RegionWeights) -> None:
        """Keep the weights of the next view."""
        size = sum(_array(weights, field.name).nbytes for field in fields(weights))
        self.bytes += size
        if self.bytes > self._limit:
            self.mapped_bytes += size
            weights = self._to_file(weights)
        self._views.append(weights)

    def _to_file(self, weights: RegionWeights) -> RegionWeights:
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="splatlift-weights-")
        mapped = {}
        for field in fields(weights):
            path = Path(self._folder.name) / f"{len(self._views)}-{field.name}.npy"
            np.save(path, _array(weights, field.name))
            mapped[field.name] = torch.from_numpy(np.load(path, mmap_mode="c"))
        return RegionWeights(**mapped)

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, view: int) -> RegionWeights:
        return self._views[view]

    def __iter__(self) -> Iterator[RegionWeights]:
        return iter(self._views)


def _array(weights: RegionWeights, name: str) -> np.ndarray:
    return getattr(weights, name).numpy()
