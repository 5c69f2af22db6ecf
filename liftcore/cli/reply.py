"""Replies of commands: one JSON object, or lines of text; and the files that they write."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from liftcore.errors import InvalidInput

MAX_ITEMS = 6  # of a list, in text
MAX_FOLDERS = 8
LARGE = 1e4  # from here on numbers have about three decimals, as map coordinates share their first digits
MAX_DIGITS = 15


def reply(document: Mapping[str, Any], *, as_json: bool, lines: Iterable[str] | None = None) -> None:
    """Print one JSON object, or else ``lines``, or else the document's entries, one a line."""
    if as_json:
        from liftcore.files import finite

        print(json.dumps(finite(document), allow_nan=False))
        return
    for line in lines if lines is not None else _entries(document):
        print(line)


OUTPUTS = {
    "object": "splats", "coloured": "ply", "labelled": "ply", "names": "json", "scores": "npy", "splat_labels": "npy",
    "csv": "csv", **dict.fromkeys(("mask", "attention", "overlay", "labels", "picture", "output"), "png"),
}  # kind of file of each option  # fmt: skip


def check_outputs(files: Mapping[str, Path], inputs: Sequence[Path]) -> None:
    """Check output files by the options that name them.

    Raises:
        InvalidInput: a file cannot be written (`check_output`), or two are the same file.
    """
    from liftcore.files import check_output

    if len({path.absolute() for path in files.values()}) < len(files):
        option_names = " and ".join(f"--{name.replace('_', '-')}" for name in files)
        raise InvalidInput(option_names, expected="different files", got="the same file twice")
    for name, path in files.items():
        check_output(path, inputs, OUTPUTS[name])


def write_files(files: Mapping[str, Path], exports: Mapping[str, Callable[[Path], None]]) -> dict[str, str]:
    """Write the files in order, each completely or not at all; after an error, no further files are written."""
    from liftcore.files import writing

    for kind, path in files.items():
        with writing(path):
            exports[kind](path)
    return {kind: str(path) for kind, path in files.items()}


def _entries(document: Mapping[str, Any]) -> Iterable[str]:
    width = max((len(str(key)) for key in document), default=0)
    for key, value in document.items():
        if key == "warnings":
            yield from (f"warning: {warning}" for warning in value)
        else:
            yield f"{str(key).replace('_', ' '):<{width}}  {short_text(value)}"


def short_text(value: Any) -> str:
    """Format a value as short text."""
    if isinstance(value, float):
        is_large = LARGE <= abs(value) < math.inf
        return f"{value:.{min(MAX_DIGITS, 4 + int(math.log10(abs(value)))) if is_large else 6}g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_nested(item)}" for key, item in value.items()) or "-"
    if isinstance(value, list | tuple):
        ellipsis = [f"... ({len(value)})"] if len(value) > MAX_ITEMS else []
        return ", ".join([*map(_nested, value[:MAX_ITEMS]), *ellipsis]) or "-"
    return "-" if value is None or value == "" else str(value)


def _nested(value: Any) -> str:
    return f"({short_text(value)})" if isinstance(value, Mapping | list | tuple) else short_text(value)


def place_of(point: tuple[float, ...]) -> str:
    """Format a point with four digits, or with about three decimals for large map coordinates."""
    reach = max(map(abs, point))
    digits = 4 if reach < LARGE else 4 + int(math.log10(reach))
    return f"({', '.join(f'{value:.{digits}g}' for value in point)})"


def smoothing_line(facts: Mapping[str, Any]) -> str:
    """Describe the smoothing of a lift (``diagnostics["smoothing"]``) in a sentence."""
    shift = "not at all" if facts["moved"] is None else f"by {facts['moved']:.1%} of their length"
    neighbourhood = "position and colour" if facts["colours"] else "position only, as the splats have no colours"
    return (
        f"smoothness {facts['smoothness']:g}: features moved {shift} towards their neighbours' in "
        f"{neighbourhood} "
        f"({facts['steps']} steps, {facts['residual']:.1g} of the gradient remaining)"
    )


def list_folders(folders: Sequence[str]) -> list[str]:
    """Return a line about the folders of views, if there are any."""
    names = ", ".join(folders[:MAX_FOLDERS]) + (" ..." if len(folders) > MAX_FOLDERS else "")
    return [f"  names of views include their sub-folders: {names}"] if folders else []
