"""Checkpoints: what the raster found in walked views outlives the process, so a killed lift goes on from there.

The geometry phase asks the raster the same questions in the same order whenever it lifts the same inputs with the
same settings. So a checkpoint is a journal of the answers, call by call, and nothing but the raster knows of it: sums
over views are formed anew from the same numbers in the same order, and a resumed lift is identical to the bit. Calls
go to the disk in blocks, each one file that is whole or not there.
"""

from __future__ import annotations

import hashlib
import json
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from llvmlite.binding import get_host_cpu_name
from safetensors import SafetensorError, safe_open

from liftcore import __version__
from liftcore.files import whole_file
from liftcore.raster.protocol import RayRows, RegionWeights
from liftcore.safetensors_header import safetensors_header, tensor_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from torch import Tensor

    from liftcore.raster.protocol import Raster
    from liftcore.scene.cameras import Camera
    from liftcore.solve.settings import LiftSettings

Kind = TypeVar("Kind")

FORMAT = "splatlift-checkpoint/1"
BLOCK_BYTES = 1 << 28  # a block is written when so much has come together, however little time went by


@dataclass(frozen=True)
class Checkpoint:
    """Where a lift keeps the views that it has walked, and how much work it is ready to lose.

    The folder belongs to one lift. It is made when there is something to keep, and is its owner's to remove.
    """

    folder: Path
    seconds: float = 2.0  # between blocks, of work


def identity(inputs: Sequence[str], settings: LiftSettings, device: Mapping[str, Any]) -> str:
    """What a checkpoint is of, in hex: inputs [sha256, ...], settings, the code, and what runs it.

    Args:
        device: the facts of the device that walks, whatever the settings ask for: devices agree within rounding only.
    """
    told = [FORMAT, __version__, get_host_cpu_name(), device, list(inputs), settings.model_dump(mode="json")]
    digest = hashlib.sha256(json.dumps(told).encode())
    for source in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(source.read_bytes())
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
    """The two questions of the geometry phase go through the journal, all others straight to the raster."""

    def __init__(self, raster: Raster, journal: _Journal) -> None:
        self._raster = raster
        self._journal = journal

    def region_weights(self, camera: Camera, *rest: Any, **named: Any) -> RegionWeights:
        call = f"region_weights {camera.name}"
        return self._journal.answer(call, RegionWeights, lambda: self._raster.region_weights(camera, *rest, **named))

    def ray_rows(self, camera: Camera, *rest: Any, **named: Any) -> RayRows:
        call = f"ray_rows {camera.name}"
        return self._journal.answer(call, RayRows, lambda: self._raster.ray_rows(camera, *rest, **named))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._raster, name)


class _Journal:
    """Answers in the order of their calls: those read back first, then new ones, written in blocks."""

    def __init__(self, checkpoint: Checkpoint, key: str) -> None:
        self._folder = checkpoint.folder
        self._seconds = checkpoint.seconds
        self._key = key
        self._known = self._read()
        self._count = 0  # calls so far
        self._fresh: list[tuple[str, dict[str, Tensor]]] = []
        self._since = time.monotonic()
        self._keeping = True

    def answer(self, call: str, kind: type[Kind], make: Callable[[], Kind]) -> Kind:
        """The answer to the next call: a dataclass of tensors, read back or made now."""
        if self._known:
            block, number, known = self._known.pop(0)
            if known == call:
                self._count += 1
                return kind(**{name: block.get_tensor(f"{number}/{name}") for name in _names(kind)})
            self._known.clear()  # of another course of work, which the key should have told
        made = make()
        self._fresh.append((call, {name: getattr(made, name) for name in _names(kind)}))
        self._count += 1
        size = sum(tensor.nbytes for _, tensors in self._fresh for tensor in tensors.values())
        if time.monotonic() - self._since >= self._seconds or size >= BLOCK_BYTES:
            self.flush()
        return made

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
            f"{number}/{name}": tensor.contiguous()
            for number, (_, answer) in enumerate(self._fresh)
            for name, tensor in answer.items()
        }
        metadata = {"key": self._key, "calls": json.dumps([call for call, _ in self._fresh])}
        specs = [(name, tensor.dtype, tuple(tensor.shape)) for name, tensor in tensors.items()]
        header, offsets = safetensors_header(specs, metadata)
        with whole_file(self._block(self._count - len(self._fresh))) as handle:
            handle.write(header)
            for name, offset in offsets.items():
                handle.seek(len(header) + offset)
                handle.write(tensor_bytes(tensors[name]))

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
            if path not in used:
                with suppress(OSError):
                    path.unlink()
        return known


def _names(kind: Any) -> list[str]:
    return [field.name for field in fields(kind)]
