"""Checkpoints: the raster's results of views are stored on disk, so that a killed lift resumes from them.

The geometry phase requests the same views from the raster whenever inputs and settings are the same. So
a checkpoint is a folder of the raster's answers, one file a view. Sums over views are computed again from the same
numbers in the same order: a resumed lift is bitwise identical. A file is complete or absent; views in progress when a
lift ends are rasterized again.

An answer is named by the digest of its request: the splats, and of a view its camera, its regions, its rays, with
those that the diagnostics sample of all views, and the compositing parameters. Features are not part of it
(``A^T B = W E``). So a lift resumes from the answers of another one that differs in features alone (another encoder,
the same regions) or in later steps.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import deque
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from llvmlite.binding import get_host_cpu_name

from liftcore.errors import InvalidInput
from liftcore.io.safetensors_file import tensor_bytes
from liftcore.raster.base import RayRows, ViewWeights
from liftcore.runtime.version import __version__
from liftcore.scene.origin import FILE_ORIGIN
from liftcore.values.region_weights import FORMAT, RegionWeights
from liftcore.values.views import Regions

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator, Mapping

    from liftcore.raster.base import Raster, ViewRequest
    from liftcore.scene.splats import Splats

_ANSWER = re.compile(r"\.?[0-9a-f]{64}\.safetensors(\.[0-9a-f]+\.part)?")  # and its unfinished files
_ROWS = {"indptr": "rows/indptr", "splats": "rows/splats", "weights": "rows/weights"}  # of RayRows, beside W


@dataclass(frozen=True)
class Checkpoint:
    """A folder of the raster's answers.

    The folder is for one lift at a time. It is created with the first answer, and the caller removes it. Files in it
    that are named as answers count as such; a lift deletes those that it did not request.
    """

    folder: Path
    identity: str = ""  # digest of the splats, the code and the device of all answers (`of`)

    def of(
        self, splats: Splats, device: Mapping[str, Any], packages: Iterable[str] = ("raster", "scene")
    ) -> Checkpoint:
        """Return the checkpoint for answers about these splats.

        Args:
            device: the facts of the device that computes: devices agree within rounding only.
            packages: of `liftcore`, whose code computes.
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
        """Yield an answer a request, in their order: from the folder where it has it, else from the raster.

        If the disk is full, the lift continues without storing more.
        """
        pending = deque[tuple[Path, ViewWeights | None]]()  # requests without a reply yet, with their stored answer
        names, requests, has_space = set[str](), iter(requests), True

        def look_up(request: ViewRequest) -> ViewWeights | None:
            path = self.folder / f"{request_digest(request, self.identity)}.safetensors"
            names.add(path.name)
            pending.append((path, _read(path)))
            return pending[-1][1]

        def cached_answers() -> Iterator[ViewWeights]:
            while pending and (answer := pending[0][1]) is not None:
                pending.popleft()
                yield answer

        first: list[ViewRequest] = []
        for request in requests:  # the raster reads requests ahead, and computes before it yields the first answer
            if look_up(request) is None:
                first.append(request)
                break
            yield from cached_answers()
        rest = (request for request in requests if look_up(request) is None)
        with closing(raster.iterate_views(chain(first, rest))) as computed:
            for answer in computed:
                yield from cached_answers()
                path = pending.popleft()[0]
                try:
                    if has_space:
                        _write(path, answer)
                except OSError:
                    has_space = False
                yield answer
                del answer  # frees its memory before the raster computes the next one
        yield from cached_answers()
        for path in self.folder.glob("*"):
            if path.name not in names and _ANSWER.fullmatch(path.name):
                with suppress(OSError):
                    path.unlink()


def request_digest(request: ViewRequest, identity: str) -> str:
    """Return the digest, in hex, of all that the answer to a request depends on."""
    camera, observed = request.camera, request.observation
    parameters: list[Any] = [identity, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
    parameters += [asdict(request.params), asdict(request.weighting), observed.codebook.shape[0]]
    parts = [torch.from_numpy(camera.viewmat.copy()), request.pixels]
    if isinstance(observed, Regions):
        parts.append(observed.labels)
    else:
        parameters.append(observed.grid.shape[:2])
    parameters += [(str(part.dtype), tuple(part.shape)) for part in parts]
    digest = hashlib.sha256(json.dumps(parameters).encode())
    for part in parts:
        digest.update(tensor_bytes(part))
    return digest.hexdigest()


def _write(path: Path, answer: ViewWeights) -> None:
    """Write an answer."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = {key: getattr(answer.rows, name) for name, key in _ROWS.items()}
    answer.weights.cpu().save(path, rows)


def _read(path: Path) -> ViewWeights | None:
    """Return the answer in a file; None if it is absent or incomplete."""
    if not path.is_file():
        return None
    try:
        weights, rows = RegionWeights.load_with_others(path)
        return ViewWeights(weights, RayRows(**{name: rows[key] for name, key in _ROWS.items()}))
    except (InvalidInput, KeyError):
        return None
