"""Region weights ``W = A^T S``: what each region of each view weighs at each splat, before any feature."""

import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from liftcore.errors import InvalidInput, reading
from liftcore.io.safetensors_file import check_arrays, map_tensors, write_tensors
from liftcore.runtime.arguments import check_count
from liftcore.runtime.cores import cores
from liftcore.runtime.memory import zeros
from liftcore.runtime.one_line import one_line

FORMAT = "splatlift-weights/2"
SCHEMA = {  # of its tensors in a file; indptr and offsets have one more than there are rows and views
    "splats": ("i4", "n"), "indptr": ("i8", "n+1"), "region": ("i4", "nnz"), "weight": ("f4", "nnz"),
    "total_weight_splats": ("i4", "m"), "total_weight": ("f4 f8", "m"), "offsets": ("i8", "V+1"),
}  # fmt: skip
MEMORY_LIMIT = 1 << 28  # bytes of W that stay in memory; what is beyond lies in mapped files
MOST_REGIONS = 2**31 - 1  # of all views: an entry names its region in four bytes
BLOCK_ENTRIES = 1 << 17  # that a thread works on at a time, unless a splat alone has more
BLOCK_ROWS = 1 << 11


@dataclass(frozen=True)
class RegionWeights:
    """``W = A'^T S`` of one view or of many, CSR by splat, and the total weight ``A^T 1``.

    ``A'`` holds the weights that the settings select, to their power; for all of them at power 1 it is A. Features of
    any encoder for the same regions are ``D^-1 W E`` with D the sums of rows. W of several views has a row for every
    splat, so that ``splats`` is 0..P - 1 and ``indptr`` [P + 1]. Tensors lie in memory, on a device, or in a mapped
    file.
    """

    splats: Tensor
    """[n] i32 ascending, the splats that have a row; it may be empty"""
    indptr: Tensor
    """[n + 1] i64, where rows begin"""
    region: Tensor
    """[nnz] i32 ascending in a row: view v's region m, or cell of a grid, is offsets[v] + m"""
    weight: Tensor
    """[nnz] f32, sums over rays of the selected w^p times the reading S"""
    total_weight_splats: Tensor
    """[m] i32 ascending, the splats that any ray met, labelled or not"""
    total_weight: Tensor
    """[m] f32, sum of plain weights w (opacity_logit_scale 1, power 1), each ray once; f64 while views are added"""
    offsets: Tensor
    """[V + 1] i64, on the CPU: the first region of each view, and their number"""
    views: tuple[str, ...] = ()
    """their names, in the order of the offsets; () if unnamed"""

    def __repr__(self) -> str:
        sizes = {"splats": self.splats.shape[0], "regions": int(self.offsets[-1]), "entries": self.region.shape[0]}
        return one_line(self, *(f"{name}={size}" for name, size in sizes.items()), f"on {self.device}")

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return sum(tensor.nbytes for tensor in self.tensors().values())

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.region.device

    def tensors(self) -> dict[str, Tensor]:
        """Return its tensors by name."""
        return {name: getattr(self, name) for name in SCHEMA}

    def cpu(self) -> Self:
        """Return the same on the CPU: all of it at once into pinned memory, as other copies wait for each part."""
        if not self.region.is_cuda:
            return self
        copies = {}
        for name, part in self.tensors().items():
            copies[name] = torch.empty(part.shape, dtype=part.dtype, pin_memory=True).copy_(part, non_blocking=True)
        torch.cuda.current_stream(self.device).synchronize()
        return replace(self, **copies)

    def in_files(self) -> Self:
        """Return the same in mapped files, of which only the pages at work are in memory.

        Raises:
            Unavailable: the disk has no room.
        """
        return replace(
            self,
            **{
                name: zeros(tuple(part.shape), part.dtype, name="weights", in_file=True).copy_(part)
                for name, part in self.tensors().items()
            },
        )

    def row_sums(self) -> Tensor:
        """``W 1``: [n] f64."""
        sums = torch.zeros(self.splats.shape[0], dtype=torch.float64, device=self.device)
        for first, last in self.blocks(BLOCK_ROWS << 4, BLOCK_ENTRIES << 2):
            starts = self.indptr[first : last + 1]
            values = self.weight[int(starts[0]) : int(starts[-1])]
            sums[first:last] = segment_sums(values, starts - starts[0])
        return sums

    def blocks(self, rows: int = BLOCK_ROWS, entries: int = BLOCK_ENTRIES) -> list[tuple[int, int]]:
        """Return (first, last) of blocks of rows, of about so many rows or entries, whichever is less."""
        return row_blocks(self.indptr.diff().cpu().numpy(), rows, entries)

    def take(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the starts [B + 1] i64 of rows [B] i64 among their entries, and their indices in W [nnz'] i64."""
        begins = self.indptr[rows]
        lengths = self.indptr[rows + 1] - begins
        starts = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
        entries = torch.repeat_interleave(begins - starts[:-1], lengths, output_size=int(starts[-1]))
        entries += torch.arange(len(entries), device=entries.device)
        return starts, entries

    def runs(self, starts: Tensor, region: Tensor) -> tuple[Tensor, Tensor]:
        """Return the runs of some rows, a run being the entries of one view in a row.

        Args:
            starts: [B + 1] i64, where the rows begin. region: [n] i32, of their entries.

        Returns:
            The first entry of each run [R + 1] i64, and the row of each [R] i64.
        """
        view = torch.searchsorted(self.offsets[1:], region, right=True)
        is_start = torch.ones_like(view, dtype=torch.bool)
        torch.not_equal(view[1:], view[:-1], out=is_start[1:])
        is_start[starts[:-1][starts.diff() > 0]] = True
        firsts = torch.nonzero(is_start)[:, 0]
        return torch.cat([firsts, starts[-1:]]), torch.searchsorted(starts, firsts, right=True) - 1

    def matrix(self, splats: int) -> csr_array:
        """W [splats, M] for scipy, a row for each of so many splats.

        Raises:
            InvalidInput: a splat of W is beyond them.
        """
        check_count("splats", splats)
        if self.splats.numel() and int(self.splats[-1]) >= splats:
            raise InvalidInput("splats", expected=f"{int(self.splats[-1]) + 1} or more", got=str(splats))
        host, lengths = self.cpu(), np.zeros(splats, np.int64)
        lengths[host.splats.numpy()] = np.diff(host.indptr.numpy())
        indptr = np.concatenate([[0], np.cumsum(lengths)])
        return csr_array((host.weight.numpy(), host.region.numpy(), indptr), shape=(splats, int(host.offsets[-1])))

    def save(self, path: Path | str, extra_tensors: Mapping[str, Tensor] | None = None) -> None:
        """Write one safetensors file, whole or not at all: its tensors by name, and ``views`` in the metadata.

        Args:
            extra_tensors: stored beside W, by other names.
        """
        metadata = {"format": FORMAT, "views": json.dumps(self.views)}
        write_tensors(Path(path), self.tensors() | dict(extra_tensors or {}), metadata)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Map a file that `save` wrote.

        Raises:
            InvalidInput: it is no such file.
        """
        return cls.load_with_others(path)[0]

    @classmethod
    def load_with_others(cls, path: Path | str) -> tuple[Self, dict[str, Tensor]]:
        """Load the weights and the other tensors of the file."""
        with reading("weights", InvalidInput, f"a file of {FORMAT}", "save it anew"):
            arrays, metadata = map_tensors(Path(path))
            if metadata.get("format") != FORMAT or not SCHEMA.keys() <= arrays.keys():
                raise ValueError("another safetensors file")
            lengths = check_arrays(arrays, SCHEMA)
            if lengths["n+1"] != lengths["n"] + 1:
                raise ValueError(f"indptr of {lengths['n']} rows, got {lengths['n+1']} places")
            views = tuple(json.loads(metadata["views"]))
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        stored = {name: tensors.pop(name) for name in SCHEMA}
        return cls(**stored, views=views), tensors


def one_view(
    splats: Tensor, indptr: Tensor, region: Tensor, weight: Tensor, total_weight_splats: Tensor, total_weight: Tensor,
    *, regions: int,
) -> RegionWeights:  # fmt: skip
    """W of a view of so many regions, as a raster finds it. See `RegionWeights`."""
    offsets = torch.tensor([0, regions])
    return RegionWeights(splats, indptr, region, weight, total_weight_splats, total_weight, offsets)


def row_blocks(lengths: np.ndarray, rows: int, entries: int) -> list[tuple[int, int]]:
    """Return (first, last) of blocks of rows: at most about so many rows and entries, at least one row."""
    before = np.concatenate([[0], np.cumsum(lengths / entries + 1 / rows)])  # of a full block
    number = max(ceil(before[-1]), 1)
    ends = np.searchsorted(before, before[-1] * np.arange(1, number) / number)
    edges = np.unique([0, *ends, lengths.size]).tolist()
    return list(pairwise(edges))


def run_each(work: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], threads: int | None) -> None:
    """Do work for tuples of arguments, whose writes do not overlap, by so many threads; None: all cores."""
    with ThreadPoolExecutor(threads or cores()) as pool:
        list(pool.map(lambda call: work(*call), arguments))


def segment_sums(values: Tensor, starts: Tensor) -> Tensor:
    """Return sums [n] f64 of values between ``starts`` [n + 1] i64, each in its order; in a fixed tree on a GPU."""
    if values.numel() == 0:
        return torch.zeros(starts.shape[0] - 1, dtype=torch.float64, device=values.device)
    return torch.segment_reduce(values.double(), "sum", offsets=starts, initial=0)
