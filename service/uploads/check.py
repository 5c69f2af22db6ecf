"""The process that reads an upload before it becomes an asset.

Run as ``python -m service.uploads.check KIND PATH MEMORY_BYTES``. It says ``ready`` once it can read, then
``valid`` with what it found, or ``invalid`` with the error: JSON lines on stdout.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

from liftcore.observe.inspect import inspect_file as inspect_features
from liftcore.observe.pack import open_packs
from liftcore.scene.inspect import inspect_file as inspect_scene

from liftcore.errors import InvalidInput, SplatliftError
from liftcore.scene.load import load_cameras, load_splats
from service.faults import fault_of
from service.uploads.checking import INVALID
from service.wire import AssetKind


def check_splats(path: Path) -> dict[str, Any]:
    """Read every splat; suffix, counts and warnings."""
    splats = load_splats(path)
    counts = {"splats": splats.count, "kernel": splats.kernel.value, "sh_degree": splats.sh_degree}
    return {"suffix": ".ply", "counts": counts, "warnings": _warnings(inspect_scene(path))}


def check_cameras(path: Path) -> dict[str, Any]:
    """Read every camera; suffix, counts and warnings."""
    cameras = load_cameras(path)
    suffix = ".zip" if zipfile.is_zipfile(path) else ".json"
    counts = {"views": len(cameras), "names": [camera.name for camera in cameras]}
    return {"suffix": suffix, "counts": counts, "warnings": _warnings(inspect_scene(path))}


def check_features(path: Path) -> dict[str, Any]:
    """Read every observation; suffix, counts and warnings."""
    packs = open_packs([path])
    for name in packs.views:
        packs.observation(name)
    counts = {
        "views": len(packs.views),
        "channels": packs.channels,
        "encoder": packs.encoder,
        "text_space": packs.text_space,
        "names": list(packs.views),
    }
    return {"suffix": ".safetensors", "counts": counts, "warnings": _warnings(inspect_features(path))}


CHECKS = {
    AssetKind.SPLATS: check_splats,
    AssetKind.CAMERAS: check_cameras,
    AssetKind.FEATURES: check_features,
}


def run(kind: AssetKind, path: Path) -> dict[str, Any]:
    """Check one file; the last message."""
    try:
        return {"event": "valid", **CHECKS[kind](path)}
    except SplatliftError as error:
        found: SplatliftError = error
    except MemoryError:
        found = _out_of_memory(kind)
    return {"event": "invalid", "fault": fault_of(found, {str(path): kind})}


def _out_of_memory(kind: AssetKind) -> InvalidInput:
    return INVALID[kind](kind, expected="a file that fits the memory of a check", got="one that needs more")


def _warnings(inspection: dict[str, Any]) -> list[str]:
    return [str(warning) for warning in inspection.get("warnings", [])]


def _say(out: BinaryIO, message: dict[str, Any]) -> None:
    out.write(json.dumps(message).encode() + b"\n")
    out.flush()


def main() -> None:
    """Check the file that the command line names."""
    kind, path, memory = AssetKind(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    # Libraries may print; the pipe is for messages only.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    # Private memory and not address space: mapped files, however large, cost none.
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    _say(out, {"event": "ready"})
    _say(out, run(kind, path))


if __name__ == "__main__":
    main()
