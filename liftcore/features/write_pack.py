"""Write feature packs one view at a time, so that memory holds one view, not the pack."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from liftcore.errors import InvalidFeatures
from liftcore.features.finite import check_finite
from liftcore.features.header import MAX_HEADER_BYTES
from liftcore.features.views import Regions, ViewFeatures
from liftcore.io.safetensors_file import safetensors_header, tensor_bytes
from liftcore.io.whole_file import whole_file
from liftcore.progress import Progress, silent

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from torch import Tensor

LARGEST_I16 = 32_767


def write_pack(
    path: Path,
    observations: Mapping[str, ViewFeatures],
    metadata: Mapping[str, str],
    progress: Progress = silent,
) -> None:
    """Write views as a feature pack, whole or not at all.

    ``observations`` may read its views when they are asked for: each is asked for twice, once for its shape
    and once for its bytes, and forgotten in between. Labels are stored as int16 where the codebook allows.

    Args:
        path: the file to write.
        observations: view name -> what it observes.
        metadata: ``encoder``, ``text_space``, ``normalised`` ("true" or "false") and what else to keep.
        progress: told about the stages "check" and "pack", in views.

    Raises:
        InvalidFeatures: there are no views, their channels differ, or a feature is not finite.
    """
    if not observations:
        raise InvalidFeatures(str(path), expected="at least one view", got="none")
    header, offsets = _header(observations, metadata, progress)
    with whole_file(path) as handle:
        handle.write(header)
        start = handle.tell()
        for done, (view, observation) in enumerate(observations.items(), start=1):
            for key, tensor in _tensors(view, observation):
                handle.seek(start + offsets[key])
                handle.write(tensor_bytes(tensor))
            progress("pack", done, len(observations), "views")


def _header(
    observations: Mapping[str, ViewFeatures], metadata: Mapping[str, str], progress: Progress
) -> tuple[bytes, dict[str, int]]:
    specs = []
    channels: dict[int, str] = {}
    for done, (view, observation) in enumerate(observations.items(), start=1):
        check_finite(observation.codebook, f"view {view!r} features")
        channels.setdefault(observation.codebook.shape[-1], view)
        specs += [(key, tensor.dtype, tuple(tensor.shape)) for key, tensor in _tensors(view, observation)]
        progress("check", done, len(observations), "views")
    if len(channels) > 1:
        got = ", ".join(f"{count} in {view!r}" for count, view in list(channels.items())[:3])
        raise InvalidFeatures("features", expected="the same channels in every view", got=got)
    header, offsets = safetensors_header(specs, metadata)
    if len(header) > MAX_HEADER_BYTES:
        raise InvalidFeatures("views", expected="fewer views in a pack", got=str(len(observations)))
    return header, offsets


def _tensors(view: str, observation: ViewFeatures) -> Iterator[tuple[str, Tensor]]:
    if isinstance(observation, Regions):
        narrow = observation.codebook.shape[0] <= LARGEST_I16
        yield f"{view}/labels", observation.labels.to(torch.int16 if narrow else torch.int32)
        yield f"{view}/codebook", observation.codebook
    else:
        yield f"{view}/grid", observation.grid
