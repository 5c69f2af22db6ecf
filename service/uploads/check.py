"""The process that reads an upload before it becomes an asset.

Run as ``python -m service.uploads.check KIND PATH MEMORY_BYTES``. It says ``ready`` once it can read, then
``valid`` with what it found, or ``invalid`` with the error: JSON lines on stdout.
"""

from __future__ import annotations

import json
import resource
import sys
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

from liftcore.errors import InvalidCameras, InvalidInput, InvalidSplats, SplatliftError
from liftcore.features.pack import read_features
from liftcore.io.checkpoint import EXPORT_PLY
from liftcore.io.class_masks import describe_masks
from liftcore.io.inspect import describe_camera_file, describe_packs, describe_splat_file, describe_table
from liftcore.io.json_file import finite
from liftcore.io.splats import SUFFIX, SplatFormat, format_of
from liftcore.query.text.table import TableEncoder
from service.child import die_with_parent, end_with_parent, fault_of, own_stdout
from service.models import VIEW_CHARACTERS, AssetKind
from service.uploads import INVALID


def check_splats(path: Path) -> dict[str, Any]:
    """Read and describe every splat; checkpoints are pickles, and are not opened here."""
    found = format_of(path)
    if found is SplatFormat.CHECKPOINT:
        got = "a checkpoint of a trainer, which is a Python pickle"
        raise InvalidSplats("splats", expected="a format that holds no code", got=got, hint=EXPORT_PLY)
    return {"suffix": SUFFIX[found], "found": describe_splat_file(path)}


def check_cameras(path: Path) -> dict[str, Any]:
    """Read and describe every camera; each must have a name that a query can say."""
    found = describe_camera_file(path)
    for name in found["names"]:
        if not 1 <= len(name) <= VIEW_CHARACTERS:
            raise InvalidCameras(
                "camera name", expected=f"1 to {VIEW_CHARACTERS} characters",
                got=f"{len(name)}: {name[:40]!r}..." if name else "an empty one",
                hint="name each image, without folders where that is enough",
            )  # fmt: skip
    return {"suffix": ".zip" if zipfile.is_zipfile(path) else ".json", "found": found}


def check_features(path: Path) -> dict[str, Any]:
    """Read and describe every observation."""
    return {"suffix": ".safetensors", "found": describe_packs(read_features(path))}


def check_masks(path: Path) -> dict[str, Any]:
    """Read and describe every mask."""
    return {"suffix": ".safetensors", "found": describe_masks(path)}


def check_table(path: Path) -> dict[str, Any]:
    """Read every row, and keep all words: orders are held to them."""
    words = list(TableEncoder.open(path).words)
    return {"suffix": ".safetensors", "found": describe_table(path) | {"words": words}}


CHECKS = {
    AssetKind.SPLATS: check_splats,
    AssetKind.CAMERAS: check_cameras,
    AssetKind.FEATURES: check_features,
    AssetKind.MASKS: check_masks,
    AssetKind.TABLE: check_table,
}


def run(kind: AssetKind, path: Path) -> dict[str, Any]:
    """Check one file; the last message."""
    try:
        checked = CHECKS[kind](path)
    except SplatliftError as error:
        return _invalid(error, kind, path)
    except MemoryError:
        return _invalid(_out_of_memory(kind), kind, path)
    counts = finite(checked["found"])  # norms of float32 rows may be infinite
    return {
        "event": "valid",
        "suffix": checked["suffix"],
        "warnings": [str(warning) for warning in counts.pop("warnings")],
        "counts": counts,
    }


def _invalid(error: SplatliftError, kind: AssetKind, path: Path) -> dict[str, Any]:
    return {"event": "invalid", "fault": fault_of(error, {str(path): kind, f"text table {path.name}": kind})}


def _out_of_memory(kind: AssetKind) -> InvalidInput:
    return INVALID[kind](kind, expected="a file that fits the memory of a check", got="one that needs more")


def _say(out: BinaryIO, message: dict[str, Any]) -> None:
    out.write(json.dumps(message).encode() + b"\n")
    out.flush()


def main() -> None:
    """Check the file that the command line names."""
    kind, path, memory = AssetKind(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    out = own_stdout()
    die_with_parent()
    end_with_parent()  # it may have died before
    # Private memory and not address space: mapped files, however large, cost none.
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    _say(out, {"event": "ready"})
    _say(out, run(kind, path))


if __name__ == "__main__":
    main()
