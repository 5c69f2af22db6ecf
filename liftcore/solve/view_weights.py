"""Where W lives between geometry and solution: on the card that made it, in memory, in mapped files beyond that."""

from __future__ import annotations

import os
import tempfile
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
import torch

from liftcore.device import indexed
from liftcore.errors import Unavailable
from liftcore.raster.base import RegionWeights

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

MEMORY_LIMIT = 1 << 28  # bytes of W that stay in memory; later views go to files


class WeightStore:
    """The region weights of every view, in view order. A context manager: leaving it removes the files.

    Args:
        memory_limit: bytes that stay in memory; None takes MEMORY_LIMIT.
        card: where weights are made, and how many bytes of them may stay there; None for the host alone.
    """

    def __init__(self, memory_limit: int | None = None, card: tuple[torch.device, int] | None = None) -> None:
        self._limit = MEMORY_LIMIT if memory_limit is None else memory_limit
        self._card_limit = card[1] if card else 0
        # Where sums over views are made: never a matter of the memory that is free, which would choose their bits.
        self.place = indexed(card[0]) if card else torch.device("cpu")
        self._on_card: set[int] = set()  # views
        self.card_bytes = 0  # of them
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
        size, number = _size(weights), len(self._views)
        if weights.columns.device == self.place and self.card_bytes + size <= self._card_limit:
            self.card_bytes += size
            self._on_card.add(number)
            self._views.append(weights)
        else:
            self._views.append(self._at_home(weights, number))

    def bring_home(self) -> None:
        """Move what lies on the card to the host, as if it had never stayed."""
        for number in sorted(self._on_card):
            self._views[number] = self._at_home(self._views[number], number)
        self._on_card.clear()
        self.card_bytes = self._card_limit = 0

    def _at_home(self, weights: RegionWeights, number: int) -> RegionWeights:
        """In memory, or in files."""
        weights, size = weights.on_host(), _size(weights)
        self.bytes += size
        if self.bytes <= self._limit:
            return weights
        self.mapped_bytes += size
        return self._to_file(weights, number)

    def blank(self) -> WeightStore:
        """The same sparsity with weights of their own, zero until they are written: columns are shared, not copied.

        The new weights stay in memory while there is room, else in files of this store, which must stay open.
        """
        copy = WeightStore(self._limit)
        for number, weights in enumerate(self._views):
            copy._views.append(replace(weights, weights=self._zeros(number, weights.weights)))
        return copy

    def _zeros(self, view: int, like: Tensor) -> Tensor:
        self.bytes += like.nbytes
        if self.bytes <= self._limit or like.nbytes == 0:
            return torch.zeros_like(like)
        self.mapped_bytes += like.nbytes
        path = self._path(f"{view}-weights-from-{self.bytes}")
        with _written():
            mapped = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=tuple(like.shape))
            with path.open("r+b") as file:  # a page that finds no disk later would end the process
                os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
        return torch.from_numpy(mapped)

    def _to_file(self, weights: RegionWeights, number: int) -> RegionWeights:
        mapped = {}
        for field in fields(weights):
            path = self._path(f"{number}-{field.name}")
            with _written():
                np.save(path, _array(weights, field.name))
            mapped[field.name] = torch.from_numpy(np.load(path, mmap_mode="c"))
        return RegionWeights(**mapped)

    def _path(self, name: str) -> Path:
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="splatlift-weights-")
        return Path(self._folder.name) / f"{name}.npy"

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, view: int) -> RegionWeights:
        return self._views[view]

    def __iter__(self) -> Iterator[RegionWeights]:
        return iter(self._views)


@contextmanager
def _written() -> Iterator[None]:
    """Say in words that a file of weights could not be written.

    Raises:
        Unavailable: the disk is full, or broken.
    """
    try:
        yield
    except OSError as error:
        folder = tempfile.gettempdir()
        hint = "set TMPDIR to a folder with more room, or lift fewer views"
        got = error.strerror or str(error)
        raise Unavailable("weights", expected=f"disk for region weights in {folder}", got=got, hint=hint) from None


def _size(weights: RegionWeights) -> int:
    return sum(getattr(weights, field.name).nbytes for field in fields(weights))


def _array(weights: RegionWeights, name: str) -> np.ndarray:
    return getattr(weights, name).numpy()
