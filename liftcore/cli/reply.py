"""Replies of commands: one JSON object, or lines of text; and the files that they write."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.errors import InvalidInput

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterable, Sequence

    from liftcore import Scene

MAX_ITEMS = 6  # of a list, in text
LARGE = 1e4  # from here on numbers may share their first digits
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
    "object": "splats", "coloured": "ply", "labelled": "ply", "names": "json", "scores": "npy", "labels": "npy",
    "csv": "csv", **dict.fromkeys(("mask", "attention", "overlay", "map", "picture", "output", "worst"), "png"),
}  # kind of file of each option  # fmt: skip
INPUTS = ("lift", "splats", "cameras", "features", "edited", "table", "words", "vocabulary", "camera", "photo")


def check_outputs(
    files: Mapping[str, Path], options: argparse.Namespace, scene: Scene | None = None, *, kind: str = "png"
) -> None:
    """Check output files before the work: they can be written, and none is an input or another of them.

    Args:
        files: by option. scene: whose own files are inputs too. kind: of the option ``output``.
    """
    from liftcore.files import check_output

    if len({path.absolute() for path in files.values()}) < len(files):
        option_names = " and ".join(f"--{name.replace('_', '-')}" for name in files)
        raise InvalidInput(option_names, expected="different files", got="the same file twice")
    paths = [(name, path) for name in INPUTS for path in paths_of(getattr(options, name, None))]
    inputs = [path for name, path in paths if name.startswith("camera") or path.is_file()]  # no other folder
    if files and scene is not None:
        metadata = scene.metadata
        inputs += [Path(file.path) for file in (metadata.splats, metadata.cameras, *metadata.features)]
    for name, path in files.items():
        check_output(path, inputs, kind if name == "output" else OUTPUTS[name.partition("-")[0]])


def outputs_of(options: argparse.Namespace) -> dict[str, Path]:
    """Return the files that options ask for, by option."""
    return {name: path for name in OUTPUTS if isinstance(path := getattr(options, name, None), Path)}


def paths_of(value: Any) -> list[Path]:
    """Return the paths in the value of an option."""
    return [path for path in (value if isinstance(value, list) else [value]) if isinstance(path, Path)]


def write_files(files: Mapping[str, Path], exports: Mapping[str, Callable[[Path], Any]]) -> dict[str, str]:
    """Write the files in order, each completely or not at all; after an error, no further files are written."""
    from liftcore.files import writing

    for name, path in files.items():
        with writing(path):
            exports[name](path)
    return {name: str(path) for name, path in files.items()}


def lines_of(document: Mapping[str, Any]) -> Iterable[str]:
    """Yield an ``answer`` as lines, an entry a line, and then the ``files``."""
    answer = document.get("answer", {})
    unit = answer.get("unit", "")
    for entry in answer.get("named_words", ()):
        yield f"  {entry['value']} {entry['word']}: {_facts(entry)}"
    for number, entry in enumerate(answer.get("objects", ()), 1):
        yield f"  object {number}: {_facts(entry, unit, 'selection')}"
    nodes = {node["id"]: node for node in answer.get("nodes", ())}
    stack = [node["id"] for node in nodes.values() if node["parent"] not in nodes][::-1]
    while stack:
        node = nodes[stack.pop()]
        yield f"{'  ' * len(node['path'])}{node['id']}{_name(node)}, {node['kind']}: {_facts(node, unit)}"
        stack += [part for part in node["parts"][::-1] if part in nodes]
    yield from (f"  {name.replace('_', ' ')}: {path}" for name, path in document["files"].items())


def _name(entry: Mapping[str, Any]) -> str:
    return "" if entry["name"] is None else f" {entry['name']} ({entry['score']:.3f})"


def _facts(entry: Mapping[str, Any], unit: str = "", whole: str = "total weight") -> str:
    """Describe a set of splats: its size, its score, its place and its views, as far as the entry has them."""
    facts = [f"{entry['splats']} splats", f"{entry['share']:.1%} of the {whole}"]
    if "name" not in entry:
        facts += [f"{name} {entry[name]:.4g}" for name in ("score", "margin") if name in entry]
    if "confidence" in entry:
        facts.append(f"masked as a whole in {entry['confidence']:.0%} of the views that see it")
    if "centre" in entry:
        facts.append(f"at {place_of(entry['centre'])}")
    low, high = entry["box"].values()
    facts.append(f"from {place_of(low)} to {place_of(high)}")
    if unit:
        facts.append(f"{' x '.join(f'{side:.4g}' for side in entry['size'])} {unit}")
    if "views" in entry:
        facts.append(f"best in {', '.join(entry['views'])}")
    return ", ".join(facts)


def _entries(document: Mapping[str, Any]) -> Iterable[str]:
    width = max((len(str(key)) for key in document), default=0)
    for key, value in document.items():
        if key == "warnings":
            yield from (f"warning: {warning}" for warning in value)
        else:
            yield f"{str(key).replace('_', ' '):<{width}}  {short_text(value)}"


def short_text(value: Any, digits: int = 6) -> str:
    """Format a value as short text; large numbers, as map coordinates, with about three decimals."""
    if isinstance(value, float):
        is_large = LARGE <= abs(value) < math.inf
        return f"{value:.{min(MAX_DIGITS, 4 + int(math.log10(abs(value)))) if is_large else digits}g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_nested(item)}" for key, item in value.items()) or "-"
    if isinstance(value, list | tuple):
        ellipsis = [f"... ({len(value)})"] if len(value) > MAX_ITEMS else []
        return ", ".join([*map(_nested, value[:MAX_ITEMS]), *ellipsis]) or "-"
    return "-" if value is None or value == "" else str(value)


def _nested(value: Any) -> str:
    return f"({short_text(value)})" if isinstance(value, Mapping | list | tuple) else short_text(value)


def place_of(point: tuple[float, ...]) -> str:
    """Format a point."""
    return f"({', '.join(short_text(value, digits=4) for value in point)})"


def smoothing_line(facts: Mapping[str, Any]) -> str:
    """Describe the smoothing of a lift (``diagnostics["smoothing"]``) in a sentence."""
    shift = "not at all" if facts["moved"] is None else f"by {facts['moved']:.1%} of their length"
    neighbourhood = "position and colour" if facts["colours"] else "position only, as the splats have no colours"
    return (
        f"smoothness {facts['smoothness']:g}: features moved {shift} towards their neighbours' in {neighbourhood} "
        f"({facts['steps']} steps, {facts['residual']:.1g} of the gradient remaining)"
    )


def list_folders(folders: Sequence[str]) -> list[str]:
    """Return a line about the folders of views, if there are any."""
    names = ", ".join(folders[:MAX_ITEMS]) + (" ..." if len(folders) > MAX_ITEMS else "")
    return [f"  names of views include their sub-folders: {names}"] if folders else []
