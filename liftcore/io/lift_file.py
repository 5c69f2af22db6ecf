"""The lift file: features on splats, with all that is needed to trust and to use them.

A ``.safetensors`` file holds ``features`` [P, F], ``evidence`` [P], ``agreement`` [P] and ``seen`` [P]; after
Post-Lifting Aggregation also ``cluster`` [P] i32, -1 for splats in none, and ``cluster_features`` [K, F]. Its
metadata hold settings, inputs with digests, the encoder, the certificate, timings and the version, as JSON.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from pydantic import BaseModel, ConfigDict, ValidationError

from liftcore.errors import InvalidLift
from liftcore.settings import LiftSettings

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = "splatlift-lift/1"
TENSORS = ("features", "evidence", "agreement", "seen")
CLUSTER_TENSORS = ("cluster", "cluster_features")  # in lifts with aggregation only


class InputFile(BaseModel):
    """Where an input was, and what it was."""

    model_config = ConfigDict(frozen=True)

    path: str  # absolute, at lift time
    sha256: str  # of the file's bytes; of the sorted (name, digest) lines for a folder


class LiftMetadata(BaseModel):
    """What a lift remembers of how it was made."""

    model_config = ConfigDict(frozen=True)

    format: str = FORMAT
    version: str
    settings: LiftSettings
    splats: InputFile
    cameras: InputFile
    features: tuple[InputFile, ...]
    encoder: str  # the 2D encoder's name as the pack tells it; "" when unknown
    text_space: str  # the text encoder that shares the space; "" or "none" when there is none
    views: tuple[str, ...]  # the views that were lifted
    certificate: dict[str, Any]
    timings: dict[str, float]  # seconds a stage


@dataclass(frozen=True)
class LiftResult:
    """X and what supports it, one row a splat."""

    features: Tensor  # [P, F] f16 or f32; zero rows where not seen
    evidence: Tensor  # [P] f32, sum of plain weights w over the feature views, each ray once
    agreement: Tensor  # [P] f32 in 0..1, norm of the weighted mean of unit regions, or of unit cells of grids
    seen: Tensor  # [P] bool, whether any labelled ray reached the splat
    metadata: LiftMetadata
    cluster: Tensor | None = None  # [P] i32, -1 = in no cluster; None without aggregation
    cluster_features: Tensor | None = None  # [K, F] like features; a zero row: its splats keep their own


def save_lift(lift: LiftResult, path: Path | str) -> None:
    """Write the lift whole or not at all (temporary file, fsync, rename), with no copy of X in memory."""
    from liftcore.io.safetensors_file import write_tensors

    present = TENSORS if lift.cluster is None else TENSORS + CLUSTER_TENSORS
    tensors = {name: getattr(lift, name) for name in present}
    write_tensors(Path(path), tensors, {"splatlift": lift.metadata.model_dump_json()})


def load_lift(path: Path) -> LiftResult:
    """Open a lift file; the tensors are mapped, not read.

    Raises:
        InvalidLift: the file is missing, is not a safetensors file, or is not a lift with a row a splat.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as handle:
            metadata = (handle.metadata() or {}).get("splatlift")
            if metadata is None:
                raise InvalidLift(str(path), expected="a lift file", got="safetensors without lift metadata")
            clusters = [name for name in CLUSTER_TENSORS if name in tuple(handle.keys())]
            tensors = {name: handle.get_tensor(name) for name in (*TENSORS, *clusters)}
        lift = LiftResult(**tensors, metadata=LiftMetadata.model_validate_json(metadata))
    except FileNotFoundError:
        raise InvalidLift(str(path), expected="a lift file", got="no such file") from None
    except (SafetensorError, OSError, ValidationError, json.JSONDecodeError) as error:
        raise InvalidLift(
            str(path), expected="a lift file (.safetensors)", got=f"a file that does not open as one: {error}"
        ) from None
    _check_shapes(lift, path)
    return lift


def _check_shapes(lift: LiftResult, path: Path) -> None:
    rows = lift.features.shape[:1]
    fits = lift.features.ndim == 2 and lift.features.dtype in (torch.float16, torch.float32) and lift.features.numel()
    columns = ((lift.evidence, torch.float32), (lift.agreement, torch.float32), (lift.seen, torch.bool))
    if not fits or any(column.shape != rows or column.dtype != dtype for column, dtype in columns):
        shapes = {name: list(getattr(lift, name).shape) for name in TENSORS}
        raise InvalidLift(str(path), expected="one row a splat in every tensor of a lift", got=str(shapes))
    _check_clusters(lift, path)


def _check_clusters(lift: LiftResult, path: Path) -> None:
    cluster, means = lift.cluster, lift.cluster_features
    if cluster is None and means is None:
        return
    if cluster is None or means is None:
        raise InvalidLift(str(path), expected="cluster and cluster_features, or neither", got="one of them")
    fits = cluster.shape == lift.features.shape[:1] and cluster.dtype == torch.int32
    fits &= means.ndim == 2 and means.shape[1:] == lift.features.shape[1:] and means.dtype == lift.features.dtype
    if not fits or int(cluster.min()) < -1 or int(cluster.max()) >= means.shape[0]:
        got = f"{list(cluster.shape)} {cluster.dtype} and {list(means.shape)} {means.dtype}"
        raise InvalidLift(str(path), expected="a cluster of -1 or a row of cluster_features for each splat", got=got)
