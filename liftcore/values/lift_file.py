"""The lift file: features on splats, with all that is needed to trust and to use them.

A ``.safetensors`` file holds ``features`` [P, F], ``total_weight`` [P] and ``has_feature`` [P]. After reweighting it
has ``confidence`` [P] f32, which tells right splats from wrong ones; after Post-Lifting Aggregation ``cluster`` [P]
i32, -1 for splats in none, and ``cluster_features`` [K, F]; where objects were looked for ``object`` [P] i32, -1 for
none, and ``object_views`` [N, 5] i32, and of the tree of objects, parts and groups ``node`` [P] i32, ``node_parents``
[T] i32, ``node_views`` [T, 5] i32, ``node_confidence`` [T] f32 and ``node_features`` [T, F] f16 (`Lift`); of packs
with words their vectors, ``embeddings`` [n, F] f32. A lift as codes (`liftcore.solve.codes`) has ``code`` [P] u16,
the row of ``features`` [K, F] of each splat, whose first row is zero; these are i8, multiples of ``feature_steps``
[F] f32 of their channels. Where nothing is lost by it, columns of i32, total weight and confidence take two bytes or
one (a confidence of u8 is in 255ths), and columns that follow from others are left out: ``has_feature`` from a code
above zero, ``object`` from ``node``. Its metadata hold settings, inputs with digests, the encoder, words, the
diagnostics, timings and the version, as JSON.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import unicodedata
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidInput, InvalidLift, reading
from liftcore.io.files import open_regular
from liftcore.io.kinds import wrong_kind
from liftcore.io.safetensors_file import check_arrays, map_tensors
from liftcore.runtime.arguments import as_path

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.scene.cameras import Camera
    from liftcore.values.lift import InputFile, Lift, LiftMetadata

FORMAT = "splatlift-lift/2"
EXPECTED, AGAIN = "a lift file (.safetensors)", "copy the file again, or lift again"
TENSORS = ("features", "total_weight", "has_feature")  # the last or a code
CONFIDENCE = "confidence"  # in lifts that were reweighted
MOST_BESIDE = 16  # files of one kind beside a lift, that are read to know one of them
DIGEST = re.compile("[0-9a-f]{64}")  # SHA-256, as `sha256_of` has it
NEAR = 3  # folders of an input's path, and above a lift, among which it is looked for
CLUSTER_TENSORS = ("cluster", "cluster_features")  # in lifts with aggregation only
OBJECT_TENSORS = ("object", "object_views")  # in lifts that looked for objects
NODE_TENSORS = ("node", "node_parents", "node_views", "node_confidence", "node_features")  # beside objects
STEPS = 2.0**-24, 512.0  # of float16: below there is none, and above bytes reach beyond its range
MOST_DEPTH = 63  # of a tree of nodes
EMBEDDINGS = "embeddings"  # in lifts of packs with words
NARROWED = {  # columns that take two bytes in the file, where that loses nothing
    "total_weight": np.float32, CONFIDENCE: np.float32, "cluster": np.int32, "object": np.int32, "node": np.int32,
}  # fmt: skip
SCHEMA = {  # types, and axes: P splats, K rows, F channels, C clusters, O objects, V views, N nodes, W words
    "features": ("i1 f2 f4", "K F"), "feature_steps": ("f4", "F"), "code": ("u2", "P"),
    "total_weight": ("f2 f4", "P"), "has_feature": ("b1", "P"), CONFIDENCE: ("u1 f2 f4", "P"),
    "cluster": ("i2 i4", "P"), "cluster_features": ("f2 f4", "C F"),
    "object": ("i2 i4", "P"), "object_views": ("i4", "O V"),
    "node": ("i2 i4", "P"), "node_parents": ("i4", "N"), "node_views": ("i4", "N V"), "node_confidence": ("f4", "N"),
    "node_features": ("f2", "N F"), EMBEDDINGS: ("f4", "W F"),
}  # fmt: skip


def save_lift(lift: Lift, path: Path | str) -> None:
    """Write the lift whole or not at all (temporary file, fsync, rename), with no copy of X in memory."""
    from liftcore.io.safetensors_file import write_tensors

    nodes, channels = lift.node_features, lift.rows.shape[1]
    if nodes is not None and nodes.shape[1] != channels:
        expected, got = f"node_features of {channels} channels, as features have", f"{nodes.shape[1]}"
        raise InvalidLift(
            "node_features", expected=expected, got=got, hint=f"replace {', '.join(NODE_TENSORS)} by None"
        )

    tensors = tensors_of(lift)
    for name in NARROWED.keys() & tensors.keys():
        tensors[name] = _narrowed(tensors[name], is_share=name == CONFIDENCE)
    if lift.code is not None:
        tensors |= _as_bytes(lift.rows)
        if ((lift.code.int() > 0) == lift.has_feature).all():
            del tensors["has_feature"]
    if {*OBJECT_TENSORS, *NODE_TENSORS} <= tensors.keys():
        object_of, _, node, parents = (tensors[name].cpu().numpy() for name in (*OBJECT_TENSORS, *NODE_TENSORS[:2]))
        if np.array_equal(_objects_of(node, parents, len(tensors["object_views"])), object_of):
            del tensors["object"]
    write_tensors(as_path(path), tensors, {"splatlift": lift.metadata.model_dump_json()})


def _narrowed(column: Tensor, is_share: bool) -> Tensor:
    """Return a column [P] i32 or f32 in two bytes, a share in one, where that loses nothing."""
    import torch

    column = column.cpu()  # another device may divide by 255 otherwise
    if is_share:
        levels = (255 * column).round().clamp(0, 255).byte()
        if torch.equal(levels.float() / 255, column):
            return levels
    narrow = column.to(torch.float16 if column.is_floating_point() else torch.int16)
    return narrow if torch.equal(narrow.to(column.dtype), column) else column


def byte_steps(rows: np.ndarray) -> np.ndarray:
    """Return the powers of two [F] f32 of which multiples in -127..127 reach to all values of rows [K, F]."""
    largest = np.abs(rows).max(axis=0).astype(np.float32) / 127
    return np.exp2(np.ceil(np.log2(np.clip(largest, *STEPS))))


def _as_bytes(features: Tensor) -> dict[str, Tensor]:
    """Return rows [K, F] f16 as i8 with their steps, if they are multiples of these; others as they are."""
    import torch

    rows = features.cpu().numpy()
    steps = byte_steps(rows)
    multiples = np.clip(np.round(rows / steps), -127, 127)
    if rows.dtype != np.float16 or not np.array_equal(multiples * steps, rows):
        return {"features": features}
    return {"features": torch.from_numpy(multiples.astype(np.int8)), "feature_steps": torch.from_numpy(steps)}


def _objects_of(node: np.ndarray, parents: np.ndarray, objects: int) -> np.ndarray:
    """Return the object [P] i32 that each splat's node is or is a part of, one of the first nodes; -1: none."""
    above, numbers = np.append(parents, np.int32(-1)), np.arange(len(parents) + 1, dtype=np.int32)
    numbers[-1] = -1
    for _ in range(MOST_DEPTH):  # -1 wraps to the last; what is no tree is refused by whoever reads it
        numbers = np.where(numbers >= objects, above.take(numbers, mode="wrap"), numbers)
    return numbers.take(node, mode="wrap")


def tensors_of(lift: Lift) -> dict[str, Tensor]:
    """Return the tensors of a lift by their names, in the order of its file."""
    columns = {**vars(lift), "features": lift.rows}
    return {name: tensor for name in SCHEMA if (tensor := columns.get(name)) is not None}


def open_lift(path: Path | str) -> Lift:
    """Open a lift file; the tensors are mapped, not read."""
    import torch

    from liftcore.values.lift import Lift

    arrays, text = read_lift(path)
    metadata = parse_metadata(text, path)
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    return Lift(tensors.pop("features"), **tensors, metadata=metadata)


def read_lift(path: Path | str) -> tuple[dict[str, np.ndarray], str]:
    """Return the mapped arrays of a lift by their names, and its metadata as JSON: without torch and pydantic."""
    source = as_path(path)
    try:
        with reading(path, InvalidLift, EXPECTED, AGAIN):
            tensors, header = map_tensors(source)
            if "splatlift" not in header:
                raise ValueError(f"{EXPECTED}, got safetensors without lift metadata")
            needed = TENSORS[: 2 if "code" in tensors else 3]
            if missing := [name for name in needed if name not in tensors]:
                _check_format(header["splatlift"])
                raise ValueError(f"{EXPECTED}, got one without {missing[0]}")
            arrays = {name: tensors[name] for name in SCHEMA if name in tensors}
            lengths = check_arrays(arrays, SCHEMA)
            if "has_feature" not in arrays:
                arrays["has_feature"] = arrays["code"] > 0
            _widen(arrays)
            _check_tensors(arrays, lengths)
            if "object_views" in arrays and "object" not in arrays:
                arrays["object"] = _objects_of(arrays["node"], arrays["node_parents"], lengths["O"])
    except InvalidLift as error:
        raise wrong_kind(source, "lift", InvalidLift, argument=str(path)) or error from None
    return arrays, header["splatlift"]


def parse_metadata(text: str, path: Path | str) -> LiftMetadata:
    """Return the metadata of a lift file from its JSON."""
    from liftcore.values.lift import LiftMetadata

    with reading(path, InvalidLift, EXPECTED, AGAIN):
        _check_format(text)
        return LiftMetadata.model_validate_json(text)


def _check_format(text: str) -> None:
    """Refuse the metadata of a lift of a later format."""
    metadata = json.loads(text)
    name = metadata.get("format", FORMAT) if isinstance(metadata, dict) else FORMAT
    if name != FORMAT:
        hint = "install the version of splatlift that wrote it, or a later one"
        raise ValueError(f"a lift of {FORMAT}, got {name!r}; {hint}")


def _widen(arrays: dict[str, np.ndarray]) -> None:
    """Replace columns that take fewer bytes in a file than in a lift; a ValueError names invalid steps."""
    features, steps = arrays["features"], arrays.pop("feature_steps", None)
    if (steps is None) != (features.dtype != np.int8):
        raise ValueError(f"feature_steps beside features of int8 alone, got features of {features.dtype}")
    if steps is not None:
        if not ((steps >= STEPS[0]) & (steps <= STEPS[1])).all() or features.min(initial=0) < -127:
            expected = f"feature_steps of {STEPS[0]:g}..{STEPS[1]:g} and features of -127..127"
            raise ValueError(f"{expected}, got {steps.min()}..{steps.max()} and from {features.min(initial=0)} on")
        arrays["features"] = (features * steps).astype(np.float16)
    if CONFIDENCE in arrays and arrays[CONFIDENCE].dtype == np.uint8:
        arrays[CONFIDENCE] = arrays[CONFIDENCE] / np.float32(255)
    for name in NARROWED.keys() & arrays.keys():
        arrays[name] = arrays[name].astype(NARROWED[name], copy=False)


def _check_tensors(arrays: dict[str, np.ndarray], lengths: dict[str, int]) -> None:
    """Refuse tensors that do not fit together; a ValueError names what is wrong."""
    if not arrays["features"].size:
        raise ValueError("features of at least one splat and channel, got none")
    code = arrays.get("code")
    if code is None and lengths["K"] != lengths["P"]:
        raise ValueError(f"features of {lengths['P']} splats, got {lengths['K']} rows")
    if code is not None and int(code.max(initial=0)) >= lengths["K"]:
        raise ValueError(f"code of 0..{lengths['K'] - 1}, got {code.max()}")
    for names in (CLUSTER_TENSORS, OBJECT_TENSORS, NODE_TENSORS):
        present, missing = ([name for name in names if (name in arrays) is has] for has in (True, False))
        if present and missing and not (missing == ["object"] and "node" in arrays):
            raise ValueError(f"{', '.join(names)} together, got {', '.join(present)} alone")
    clusters = arrays.get("cluster_features")
    if clusters is not None and clusters.dtype != arrays["features"].dtype:
        raise ValueError(f"cluster_features {arrays['features'].dtype} as features, got {clusters.dtype}")
    for name, axis in (("cluster", "C"), ("object", "O"), ("node", "N"), ("node_parents", "N")):
        numbers = arrays.get(name, np.empty(0, np.int32))
        if int(numbers.min(initial=-1)) < -1 or int(numbers.max(initial=-1)) >= lengths.get(axis, 0):
            raise ValueError(f"{name} of -1..{lengths[axis] - 1}, got {numbers.min()}..{numbers.max()}")
    above = arrays.get("node_parents", np.empty(0, np.int32))
    if "node" in arrays and lengths.get("O", 0) > len(above):
        raise ValueError(f"a node for each of {lengths['O']} objects, got {len(above)}")
    above = np.append(above, np.int32(-1))
    for _ in range(MOST_DEPTH.bit_length()):  # each step leads twice as far up
        above = above[above]
    if (above >= 0).any():
        raise ValueError(f"nodes of a tree, at most {MOST_DEPTH} deep, got others")


def input_files(splats: Path, cameras: Path, features: Sequence[Path]) -> list[InputFile]:
    """Return the inputs of a lift with their digests: splats, cameras (by `camera_input`) and feature packs."""
    return [input_file(splats), camera_input(cameras), *(input_file(pack) for pack in features)]


def input_file(path: Path) -> InputFile:
    """Return the path and the digest of a file, or of a SOG that is not bundled."""
    from liftcore.io.sog import META, sog_files

    resolved = path.resolve()
    is_folder = resolved.is_dir() or resolved.name == META
    return _input_of(resolved, sog_files(resolved) if is_folder else [resolved])


def camera_input(path: Path) -> InputFile:
    """Return the path of cameras, and the digest of their file or, of several, of the names and digests of all read.

    Photos, features and lifts that lie in the same folder do not count: they may come and go.
    """
    from liftcore.io.cameras import camera_source

    absolute = Path(os.path.abspath(path))  # links stay: other files count beside them than where they lead
    return _input_of(absolute, camera_source(absolute).files)


def _input_of(path: Path, files: Sequence[Path]) -> InputFile:
    """Return an input with the digest of its file or, of several, of their names and digests."""
    from liftcore.values.lift import InputFile

    if [*files] == [path]:
        return InputFile(path=str(path), sha256=sha256_of(path))
    total, folder = hashlib.sha256(), path if path.is_dir() else path.parent
    for part in files:
        total.update(f"{os.path.relpath(part, folder)} {sha256_of(part)}\n".encode())
    return InputFile(path=str(path), sha256=total.hexdigest())


def found_input(role: str, recorded: InputFile, metadata: LiftMetadata, lift: Path | None) -> Path | None:
    """Find an input of a lift: at its recorded path, near the lift, or in the lift's store; else None.

    Cameras match if those of the lifted views are unchanged, whatever other views there are.

    Args:
        role: splats, cameras or features. lift: the lift's file; None looks at the recorded path alone.
    """
    path = Path(recorded.path)
    places, parts = [path], path.parts[1:]
    for above in () if lift is None else Path(os.path.abspath(lift)).parents[: NEAR + 1]:
        places += [above.joinpath(*parts[-count:]) for count in range(1, min(len(parts), NEAR) + 1)]
    if lift is not None and path.suffix:
        folder = Path(os.path.abspath(lift)).parent
        places += sorted(folder.glob(f"[!.]*{path.suffix}"))[:MOST_BESIDE]  # under another name
        if DIGEST.fullmatch(recorded.sha256):  # the stored value of another lift may be a pattern, not a digest
            places += folder.parent.glob(f"blobs/{recorded.sha256}.*")  # of the service
    for place in places:
        if place.exists():
            with suppress(InvalidInput, OSError):
                candidate = camera_input(place) if role == "cameras" else input_file(place)
                if candidate.sha256 == recorded.sha256 or (role == "cameras" and has_poses(place, metadata)):
                    return place
    return None


def has_poses(place: Path, metadata: LiftMetadata) -> bool:
    """Return True if a file or folder has the cameras of the lifted views as they were, whatever others it has."""
    from liftcore.io.cameras import read_cameras

    cameras = read_cameras(place)
    matches = [cameras[view] for view in metadata.views if view in cameras]
    if len(matches) != len(metadata.views):
        return False
    return metadata.poses == poses_of(matches)


def poses_of(cameras: Sequence[Camera]) -> str:
    """Return a digest of what cameras see, in their order, with their names in composed form."""
    total = hashlib.sha256()
    for camera in cameras:
        total.update(camera.viewmat.tobytes() + camera.K.tobytes())
        description = (unicodedata.normalize("NFC", camera.name), camera.width, camera.height, camera.lens)
        total.update(repr(description).encode())
    return total.hexdigest()


def sha256_of(path: Path) -> str:
    """Return the digest of a file, in hexadecimal digits."""
    with open_regular(path) as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
