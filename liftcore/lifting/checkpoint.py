"""Checkpoints: what the raster found of views outlives the process, so a killed lift goes on from there.

The geometry phase asks the raster for the same views whenever it lifts the same inputs with the same settings. So a
checkpoint is a folder of the raster's answers, one file a view, and nothing but the raster knows of it: sums over
views are formed anew from the same numbers in the same order, and a resumed lift is identical to the bit. A file is
whole or not there; the views in work when a lift ends are rasterized again.

An answer is named by what was asked: the splats, and of a view its camera, its regions, its rays and how they meet
splats. No feature is among that (``A^T B = W E``), so a lift goes on from the answers of another where only features
differ (another encoder's of the same regions), where others of the views are taken, or what is made of W afterwards.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections import deque
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from llvmlite.binding import get_host_cpu_name

from liftcore.errors import InvalidInput
from liftcore.io.remote import check_path
from liftcore.io.safetensors_file import tensor_bytes
from liftcore.raster.base import RayRows, ViewWeights
from liftcore.runtime.version import __version__
from liftcore.scene.origin import FILE_ORIGIN
from liftcore.values.region_weights import FORMAT, MEMORY_LIMIT, RegionWeights
from liftcore.values.views import Regions

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator, Mapping

    from liftcore.raster.base import Raster, ViewRequest
    from liftcore.scene.splats import Splats

_ANSWER = re.compile(r"\.?([0-9a-f]{64}|\d{6,})\.safetensors(\.[0-9a-f]+\.part)?")  # by name, and its drafts
_ROWS = {"indptr": "rows/indptr", "splats": "rows/splats", "weights": "rows/weights"}  # of RayRows, beside W


@dataclass(frozen=True)
class Checkpoint:
    """Where a lift keeps what it found of views, and of what.

    The folder is for one lift at a time. It is made when there is something to keep, and is its owner's to remove. Of
    what lies in it, files that are named as answers are taken for them, and go when a lift did not ask for them.
    """

    folder: Path
    seconds: float = 2.0  # between writes, of work that is lost with the process; views in work may be lost too
    identity: str = ""  # of the splats, the code and the device that all answers are of (`of`)

    def __post_init__(self) -> None:
        check_path(self.folder, "folder")
        object.__setattr__(self, "folder", Path(self.folder))

    def of(
        self, splats: Splats, device: Mapping[str, Any], packages: Iterable[str] = ("raster", "scene")
    ) -> Checkpoint:
        """The same for answers about these splats.

        Args:
            device: the facts of the device that answers: devices agree within rounding only.
            packages: of `liftcore`, whose code answers.
        """
        digest = hashlib.sha256(json.dumps([FORMAT, __version__, get_host_cpu_name(), device]).encode())
        for package in packages:
            for source in sorted((Path(__file__).parents[1] / package).rglob("*.py")):
                digest.update(source.read_bytes())
        digest.update(splats.kernel.value.encode())
        for part in (splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.beta):
            digest.update(b"" if part is None else tensor_bytes(part))
        digest.update(b"" if splats.origin == FILE_ORIGIN else repr(splats.origin).encode())
        return replace(self, identity=digest.hexdigest())

    def answers(self, raster: Raster, requests: Iterable[ViewRequest]) -> Generator[ViewWeights]:
        """What the raster answers, in the order of the requests: from the folder what it answered before.

        Without room for more the lift goes on, and keeps no more.
        """
        asked = deque[tuple[Path, ViewWeights | None]]()  # not answered yet, with what is known of them
        named, fresh, requests = set[str](), _Fresh(self.seconds), iter(requests)

        def look_up(request: ViewRequest) -> ViewWeights | None:
            path = self.folder / f"{question(request, self.identity)}.safetensors"
            named.add(path.name)
            asked.append((path, _read(path)))
            return asked[-1][1]

        def known() -> Iterator[ViewWeights]:
            while asked and (answer := asked[0][1]) is not None:
                asked.popleft()
                yield answer

        first: list[ViewRequest] = []
        for request in requests:  # the raster takes requests ahead, and works for them before it answers the first
            if look_up(request) is None:
                first.append(request)
                break
            yield from known()
        rest = (request for request in requests if look_up(request) is None)
        with closing(raster.iterate_views(chain(first, rest))) as found:
            for answer in found:
                yield from known()
                fresh.keep(asked.popleft()[0], answer)
                yield answer
                del answer  # before the next one is made beside it
        fresh.write()
        yield from known()
        for path in self.folder.glob("*"):
            if path.name not in named and _ANSWER.fullmatch(path.name):
                with suppress(OSError):
                    path.unlink()


def question(request: ViewRequest, identity: str) -> str:
    """What is asked of one view, in hex: all that its answer depends on."""
    camera, observed = request.camera, request.observation
    told: list[Any] = [identity, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
    told += [asdict(request.params), asdict(request.weighting), observed.codebook.shape[0]]
    parts = [torch.from_numpy(camera.viewmat.copy()), request.pixels]
    if isinstance(observed, Regions):
        parts.append(observed.labels)
    else:
        told.append(observed.grid.shape[:2])
    told += [(str(part.dtype), tuple(part.shape)) for part in parts]
    digest = hashlib.sha256(json.dumps(told).encode())
    for part in parts:
        digest.update(tensor_bytes(part))
    return digest.hexdigest()


class _Fresh:
    """Answers that are not on the disk yet. Without room there they are dropped, and so are all that follow."""

    def __init__(self, seconds: float) -> None:
        self._answers: list[tuple[Path, ViewWeights]] = []
        self._seconds, self._since, self._room = seconds, time.monotonic(), True

    def keep(self, path: Path, answer: ViewWeights) -> None:
        """Keep an answer, which goes to the disk when it is time, or with too many others."""
        self._answers.append((path, replace(answer, weights=answer.weights.cpu())))
        size = sum(answer.weights.nbytes for _, answer in self._answers)
        if time.monotonic() - self._since >= self._seconds or size >= MEMORY_LIMIT:
            self.write()

    def write(self) -> None:
        """Write them, a file each."""
        try:
            for path, answer in self._answers if self._room else ():
                path.parent.mkdir(parents=True, exist_ok=True)
                answer.weights.save(path, {key: getattr(answer.rows, name) for name, key in _ROWS.items()})
        except OSError:
            self._room = False
        self._answers.clear()
        self._since = time.monotonic()


def _read(path: Path) -> ViewWeights | None:
    """The answer that lies there; None where there is none, or no whole one."""
    if not path.is_file():
        return None
    try:
        weights, others = RegionWeights.load_with_others(path)
        return ViewWeights(weights, RayRows(**{name: others[key] for name, key in _ROWS.items()}))
    except (InvalidInput, KeyError):
        return None
