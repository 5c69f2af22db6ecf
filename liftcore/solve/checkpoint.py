"""Checkpoints: what the raster found in walked views outlives the process, so a killed lift goes on from there.

The geometry phase asks the raster for the same views in the same order whenever it lifts the same inputs with the
same settings. So a checkpoint is a journal of the answers, view by view, and nothing but the raster knows of it: sums
over views are formed anew from the same numbers in the same order, and a resumed lift is identical to the bit. Views
go to the disk in blocks, each one file that is whole or not there; those in work when a lift ends are walked again.

An answer is known by what was asked: the splats, and of a view its camera, its regions, its rays and how they walk.
No feature is among that (``A^T B = W E``), so a lift goes on from the answers of another where only features differ
(another encoder's of the same regions), or what is made of W afterwards.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections import deque
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from llvmlite.binding import get_host_cpu_name
from safetensors import SafetensorError, safe_open

from liftcore import __version__
from liftcore.features.views import Regions
from liftcore.io.safetensors_file import tensor_bytes, write_tensors
from liftcore.raster.base import RayRows, RegionWeights, ViewWeights

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator, Mapping

    from torch import Tensor

    from liftcore.raster.base import Raster, ViewRequest
    from liftcore.scene.splats import Splats

FORMAT = "splatlift-checkpoint/3"
_BLOCK = re.compile(r"\d{6,}\.safetensors|\.\d{6,}\.safetensors\.[0-9a-f]+\.part")  # by name, and its drafts
_PARTS = {"weights": RegionWeights, "rows": RayRows}  # of ViewWeights
BLOCK_BYTES = 1 << 28  # a block is written when so much has come together, however little time went by


@dataclass(frozen=True)
class Checkpoint:
    """Where a lift keeps the views that it has walked, and how much work it is ready to lose.

    The folder is for one lift at a time. It is made when there is something to keep, and is its owner's to remove. Of
    what lies in it, files that are named as blocks are taken for them, and go when they are of no use.
    """

    folder: Path
    seconds: float = 2.0  # between blocks, of work; views in work may be lost too


def identity(splats: Splats, device: Mapping[str, Any]) -> str:
    """What all answers of a checkpoint are of, in hex: the splats, the code that walks, and what runs it.

    Args:
        device: the facts of the device that walks, whatever the settings ask for: devices agree within rounding only.
    """
    digest = hashlib.sha256(json.dumps([FORMAT, __version__, get_host_cpu_name(), device]).encode())
    for source in sorted((Path(__file__).parents[1] / "raster").rglob("*.py")):
        digest.update(source.read_bytes())
    digest.update(splats.kernel.value.encode())
    for part in (splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.beta):
        digest.update(b"" if part is None else tensor_bytes(part))
    return digest.hexdigest()


def question(look: ViewRequest) -> str:
    """What is asked of one view, in hex: all that its answer depends on beside the splats."""
    camera, observed = look.camera, look.observation
    told: list[Any] = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
    told += [asdict(look.params), asdict(look.weighting), observed.codebook.shape[0]]
    parts = [torch.from_numpy(camera.viewmat.copy()), look.pixels]
    if isinstance(observed, Regions):
        parts.append(observed.labels)
    else:
        told.append(observed.grid.shape[:2])
    told += [(str(part.dtype), tuple(part.shape)) for part in parts]
    digest = hashlib.sha256(json.dumps(told).encode())
    for part in parts:
        digest.update(tensor_bytes(part))
    return digest.hexdigest()


@contextmanager
def resumed(raster: Raster, checkpoint: Checkpoint | None, key: str) -> Iterator[Raster]:
    """The raster, answering from the checkpoint what it has answered before; as it is when there is no checkpoint.

    Args:
        key: what the work is of (`identity`); a checkpoint of anything else is removed.
    """
    if checkpoint is None:
        yield raster
        return
    journal = _Journal(checkpoint, key)
    yield cast("Raster", _ResumedRaster(raster, journal))
    journal.flush()


class _ResumedRaster:
    """The geometry phase's question goes through the journal, all others straight to the raster."""

    def __init__(self, raster: Raster, journal: _Journal) -> None:
        self._raster = raster
        self._journal = journal

    def iterate_views(self, looks: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        looks, asked = iter(looks), deque[str]()

        def noted(look: ViewRequest) -> ViewRequest:
            asked.append(question(look))
            return look

        for look in looks:
            known = self._journal.known(question(look))
            if known is not None:
                yield known
                continue
            with closing(self._raster.iterate_views(map(noted, chain([look], looks)))) as rest:
                for walked in rest:
                    self._journal.keep(asked.popleft(), walked)
                    yield walked
                    del walked  # before the next one is made beside it

    def __getattr__(self, name: str) -> Any:
        return getattr(self._raster, name)


class _Journal:
    """Views in the order of their walks: those read back first, then new ones, written in blocks."""

    def __init__(self, checkpoint: Checkpoint, key: str) -> None:
        self._folder = checkpoint.folder
        self._seconds = checkpoint.seconds
        self._key = key
        self._known = self._read()
        self._count = 0  # views so far
        self._fresh: list[tuple[str, dict[str, Tensor]]] = []
        self._since = time.monotonic()
        self._keeping = True

    def known(self, asked: str) -> ViewWeights | None:
        """The answer to the next question, if it is on the disk."""
        if not self._known:
            return None
        block, number, known = self._known.pop(0)
        if known != asked:
            self._known.clear()  # of another course of work: what follows is written over it
            return None
        self._count += 1
        weights, rows = (
            {name: block.get_tensor(f"{number}/{part}/{name}") for name in _names(kind)}
            for part, kind in _PARTS.items()
        )
        return ViewWeights(RegionWeights(**weights), RayRows(**rows))

    def keep(self, asked: str, walked: ViewWeights) -> None:
        """Note the answer to the next question."""
        walked = replace(walked, weights=walked.weights.on_host())
        tensors = {
            f"{part}/{name}": getattr(getattr(walked, part), name)
            for part, kind in _PARTS.items()
            for name in _names(kind)
        }
        self._fresh.append((asked, tensors))
        self._count += 1
        size = sum(tensor.nbytes for _, tensors in self._fresh for tensor in tensors.values())
        if time.monotonic() - self._since >= self._seconds or size >= BLOCK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write what is not on the disk yet. Without room for it the lift goes on, and keeps no more."""
        if self._fresh and self._keeping:
            try:
                self._write()
            except OSError:
                self._keeping = False
        self._fresh.clear()
        self._since = time.monotonic()

    def _write(self) -> None:
        tensors = {
            f"{number}/{name}": tensor
            for number, (_, answer) in enumerate(self._fresh)
            for name, tensor in answer.items()
        }
        metadata = {"key": self._key, "calls": json.dumps([call for call, _ in self._fresh])}
        write_tensors(self._block(self._count - len(self._fresh)), tensors, metadata)

    def _block(self, first: int) -> Path:
        return self._folder / f"{first:06d}.safetensors"

    def _read(self) -> list[tuple[Any, int, str]]:
        """The calls on the disk, from the first on without a gap; what does not belong to them is removed."""
        known: list[tuple[Any, int, str]] = []
        used = set()
        while (path := self._block(len(known))).is_file():
            try:
                block = safe_open(str(path), framework="pt")
            except (SafetensorError, OSError):
                break
            metadata = block.metadata() or {}
            calls = json.loads(metadata.get("calls", "[]"))
            if metadata.get("key") != self._key or not calls:
                break
            used.add(path)
            known += [(block, number, call) for number, call in enumerate(calls)]
        for path in self._folder.glob("*"):
            if path not in used and _BLOCK.fullmatch(path.name):
                with suppress(OSError):
                    path.unlink()
        return known


def _names(kind: Any) -> list[str]:
    return [field.name for field in fields(kind)]
