"""The errand that reads a feature pack's header and gives it other names (`service.errand`)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from liftcore.io.safetensors_file import with_metadata


def run(pack: str, changes: str, header: str) -> dict[str, Any]:
    """Write what the pack begins with, its length and its header, under the names of ``changes``, a JSON object.

    Args:
        pack: a pack that was checked.
        header: the file to write.
    """
    Path(header).write_bytes(next(with_metadata(Path(pack), json.loads(changes))))
    return {"event": "valid"}
