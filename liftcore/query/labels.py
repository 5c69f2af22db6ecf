"""What every splat is, for other programs: a PLY with labels a splat, and a JSON document of what they mean."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidLift
from liftcore.query.objects import LEAST_EVIDENCE, trimmed_box
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.runtime.version import __version__
from liftcore.scene.touching import touching

if TYPE_CHECKING:
    from liftcore.query.segment import Segmentation

FORMAT = "splatlift-labels/1"
FRAMES = {
    "colmap": "that of the COLMAP model that was lifted: right-handed, its unit",
    "file": "that of the splat file that was lifted, with x, y and z as its PLY has them",
}


@dataclass(frozen=True)
class Labels:
    """Columns of a PLY, and the document that says what their numbers mean."""

    columns: dict[str, np.ndarray]  # name -> [P] i32 or f32
    document: dict[str, Any]


def labels(scene: OpenedLift, segmentation: Segmentation) -> Labels:
    """The labels of a segmentation.

    ``class_id`` is the value of a splat's word (`Segmentation.values`), ``instance_id`` counts groups of splats of
    one word that touch (`liftcore.scene.touching`), with the most evidence first; 0 is none of both. Groups
    with less than a twentieth of the evidence of their word's largest have a class alone. ``score`` is the cosine to
    the word. ``confidence`` is the lift's, where it was reweighted; other lifts have none.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
    """
    values = segmentation.values
    instances, told = np.zeros(len(values), np.int32), list[dict[str, Any]]()
    evidence = scene.evidence.astype(np.float64)
    for value, named in enumerate(segmentation.found, 1):
        rows = np.flatnonzero(values == value)
        weights = evidence[rows] if evidence[rows].any() else np.ones(len(rows))
        groups = touching(scene.splats, rows)
        sums = np.bincount(groups, weights)
        for group in np.argsort(-sums, kind="stable")[: int((sums >= LEAST_EVIDENCE * sums.max()).sum())].tolist():
            inside = groups == group
            own, mine = rows[inside], weights[inside]
            instances[own] = len(told) + 1
            one = {"instance_id": len(told) + 1, "class_id": value, "name": named.word, "splats": len(own)}
            one |= {"score": float(np.average(segmentation.score[own], weights=mine))}
            told.append(one | _boxes(scene.splats.positions(own).astype(np.float64), mine))
    columns = {"class_id": values.astype(np.int32), "instance_id": instances, "score": segmentation.score}
    if scene.confidence is not None:
        columns["confidence"] = np.where(values > 0, as_numpy(scene.confidence), 0).astype(np.float32)
    frame = _frame(scene)
    document = {
        "format": FORMAT,
        "made_by": f"splatlift {__version__}",
        "splats": len(values),
        "columns": list(columns),
        "frame": frame,
        "frame_is": FRAMES[frame],
        "classes": [
            {
                "class_id": value,
                "name": named.word,
                "colour": segmentation.colours[value].tolist(),
                "splats": named.splats,
                "score": named.score,
                "margin": named.margin,
                "box": {"low": named.box[0], "high": named.box[1]},
                "instances": [one["instance_id"] for one in told if one["class_id"] == value],
            }
            for value, named in enumerate(segmentation.found, 1)
        ],
        "instances": told,
    }
    return Labels(columns, document)


def labelled_ply(scene: OpenedLift, made: Labels) -> Iterator[bytes]:
    """All splats with the columns, as a file in blocks; every other property to the byte.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
    """
    from liftcore.io.splats import with_columns

    return with_columns(scene.splat_file, made.columns)


def document_bytes(made: Labels) -> bytes:
    """The document as a JSON file."""
    return json.dumps(made.document, ensure_ascii=False, indent=1).encode() + b"\n"


def _boxes(means: np.ndarray, weights: np.ndarray) -> dict[str, Any]:
    """The axis-aligned box of some splats' centres, and one along their principal axes.

    Both leave a thousandth of the evidence out at each end of each axis.
    """
    low, high = trimmed_box(means, weights)
    middle = np.average(means, axis=0, weights=weights)
    spread = (means - middle).T @ ((means - middle) * weights[:, None])
    axes = np.linalg.eigh(spread)[1][:, ::-1].T  # rows, the longest first
    axes[2] = np.cross(axes[0], axes[1])  # right-handed
    ends = np.array(trimmed_box((means - middle) @ axes.T, weights))
    return {
        "box": {"low": low, "high": high},
        "oriented_box": {
            "centre": (middle + ends.mean(axis=0) @ axes).tolist(),
            "axes": axes.tolist(),
            "half_sizes": ((ends[1] - ends[0]) / 2).tolist(),
        },
    }


def _frame(scene: OpenedLift) -> str:
    """Whose frame boxes and splats are in, as far as the lift's files tell."""
    from liftcore.io.cameras import camera_source

    try:
        cameras, path = scene.cameras, Path(scene.metadata.cameras.path)
    except InvalidLift:
        return "file"
    moved = cameras.frame is not None or cameras.of_nerfstudio
    is_colmap = bool(path.name) and (
        camera_source(path, scene.metadata.views).model is not None or zipfile.is_zipfile(path)
    )
    return "colmap" if is_colmap and not moved else "file"
