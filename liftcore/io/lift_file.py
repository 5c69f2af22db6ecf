"""The lift file: features on splats, with all that is needed to trust and to use them.

A ``.safetensors`` file holds ``features`` [P, F], ``evidence`` [P], ``agreement`` [P] and ``seen`` [P]; after
Post-Lifting Aggregation also ``cluster`` [P] i32, -1 for splats in none, and ``cluster_features`` [K, F]. Its
metadata hold settings, inputs with digests, the encoder, the certificate, timings and the version, as JSON.
"""

from __future__ import annotations

import json
from pathlib import Path

import torch
from pydantic import ValidationError

from liftcore.errors import InvalidLift
from liftcore.result import LiftMetadata, LiftResult

TENSORS = ("features", "evidence", "agreement", "seen")
CLUSTER_TENSORS = ("cluster", "cluster_features")  # in lifts with aggregation only


def save_lift(lift: LiftResult, path: Path | str) -> None:
    """Write the lift whole or not at all (temporary file, fsync, rename), with no copy of X in memory."""
    from liftcore.io.safetensors_file import write_tensors

    present = TENSORS if lift.cluster is None else TENSORS + CLUSTER_TENSORS
    tensors = {name: getattr(lift, name) for name in present}
    write_tensors(Path(path), tensors, {"splatlift": lift.metadata.model_dump_json()})


def load_lift(path: Path | str) -> LiftResult:
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


def _check_shapes(lift: LiftResult, path: Path | str) -> None:
    rows = lift.features.shape[:1]
    fits = lift.features.ndim == 2 and lift.features.dtype in (torch.float16, torch.float32) and lift.features.numel()
    columns = ((lift.evidence, torch.float32), (lift.agreement, torch.float32), (lift.seen, torch.bool))
    if not fits or any(column.shape != rows or column.dtype != dtype for column, dtype in columns):
        shapes = {name: list(getattr(lift, name).shape) for name in TENSORS}
        raise InvalidLift(str(path), expected="one row a splat in every tensor of a lift", got=str(shapes))
    _check_clusters(lift, path)


def _check_clusters(lift: LiftResult, path: Path | str) -> None:
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
