"""JSON: camera files read under a limit, checked values, and finite output."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.errors import InvalidCameras, reading
from liftcore.io.files import open_regular, refuse_pointer

MAX_JSON_BYTES = 64 * 1024 * 1024
FORMATS = "an object with 'frames' (nerfstudio) or a list of cameras with 'img_name' (Inria)"


def read_json(path: Path) -> Any:
    """Read the document in a JSON file of at most 64 MiB."""
    with reading(path, InvalidCameras, "a camera file"):
        with open_regular(path) as handle:
            content = handle.read(MAX_JSON_BYTES + 1)
        if len(content) > MAX_JSON_BYTES:
            raise ValueError(f"JSON of at most {MAX_JSON_BYTES} bytes, got a larger file")
        refuse_pointer(str(path), content)
    with reading(path, InvalidCameras, "cameras as JSON"):
        try:
            return json.loads(content)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"cameras as JSON, got a file that does not parse ({str(error)[:120]})") from None


def number(value: Any, name: str) -> float:
    """Check that a value is a finite number, and return it as float."""
    try:
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:
        pass  # an integer beyond every float is refused as infinity is
    raise ValueError(f"a finite number as {name}, got {repr(value)[:60]}")


def pixels(value: Any, name: str) -> int:
    """Check that a value is a whole number of pixels; 990.0 counts as 990."""
    count = number(value, name)
    if count != int(count):
        raise ValueError(f"a whole number of pixels as {name}, got {repr(value)[:60]}")
    return int(count)


def matrix(value: Any, rows: tuple[int, ...], columns: int, name: str) -> np.ndarray:
    """Convert nested lists to a matrix [r, columns] f64, r being one of ``rows``."""
    shaped = isinstance(value, list) and len(value) in rows
    if not shaped or not all(isinstance(row, list) and len(row) == columns for row in value):
        shapes = " or ".join(f"{count}x{columns}" for count in rows)
        raise ValueError(f"a {shapes} matrix of nested lists as {name}, got {repr(value)[:60]}")
    return np.array([[number(cell, name) for cell in row] for row in value])


def finite(value: Any) -> Any:
    """Replace infinities and NaN with null, at any depth of mappings, lists and tuples."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): finite(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite(inner) for inner in value]
    return value
