"""The lift file: features on splats, with all that is needed to trust and to use them.

A ``.safetensors`` file holds ``features`` [P, F], ``evidence`` [P], ``agreement`` [P] and ``seen`` [P];
its metadata hold settings, inputs with digests, the encoder, the certificate, timings and the version, as JSON.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, ValidationError

from liftcore.errors import InvalidLift
from liftcore.solve.settings import LiftSettings

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = "splatlift-lift/1"


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
class Lift:
    """X and what supports it, one row a splat."""

    features: Tensor  # [P, F] f16 or f32; zero rows where not seen
    evidence: Tensor  # [P] f32, sum of plain weights w over the feature views, each ray once
    agreement: Tensor  # [P] f32 in 0..1, norm of the weighted mean of unit inputs
    seen: Tensor  # [P] bool, whether any labelled ray reached the splat
    metadata: LiftMetadata


def save_lift(lift: Lift, path: Path) -> None:
    """Write the lift whole or not at all (temporary file, fsync, rename)."""
    from safetensors.torch import save_file

    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    tensors = {
        "features": lift.features,
        "evidence": lift.evidence,
        "agreement": lift.agreement,
        "seen": lift.seen,
    }
    try:
        save_file(tensors, str(draft), metadata={"splatlift": lift.metadata.model_dump_json()})
        with draft.open("rb") as handle:
            os.fsync(handle.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def load_lift(path: Path) -> Lift:
    """Open a lift file; the tensors are mapped, not read.

    Raises:
        InvalidLift: the file is missing, is not a safetensors file, or is not a lift.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as handle:
            metadata = (handle.metadata() or {}).get("splatlift")
            if metadata is None:
                raise InvalidLift(str(path), expected="a lift file", got="safetensors without lift metadata")
            tensors = {name: handle.get_tensor(name) for name in ("features", "evidence", "agreement", "seen")}
        return Lift(**tensors, metadata=LiftMetadata.model_validate_json(metadata))
    except FileNotFoundError:
        raise InvalidLift(str(path), expected="a lift file", got="no such file") from None
    except (SafetensorError, OSError, ValidationError, json.JSONDecodeError) as error:
        raise InvalidLift(
            str(path), expected="a lift file (.safetensors)", got=f"a file that does not open as one: {error}"
        ) from None
