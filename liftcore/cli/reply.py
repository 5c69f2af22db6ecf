"""How commands answer: one JSON object, or lines for people; and bars on stderr for somebody who watches."""

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from liftcore.errors import InvalidInput

SHOWN_ITEMS = 6  # of a list, for people
SHOWN_FOLDERS = 8
LARGE = 1e5  # from here on numbers show about three decimals: places in map coordinates begin alike
MOST_DIGITS = 15


def reply(document: Mapping[str, Any], *, as_json: bool, lines: Iterable[str] | None = None) -> None:
    """Print one JSON object, or else ``lines``, or else the document's entries, a line each."""
    if as_json:
        from liftcore.io.json_file import finite  # loads numpy

        print(json.dumps(finite(document), allow_nan=False))
        return
    for line in lines if lines is not None else _entries(document):
        print(line)


@dataclass(frozen=True)
class OutputType:
    """What an option writes."""

    name: str  # as errors have it
    suffixes: tuple[str, ...]
    kind: str | None  # of `liftcore.io.kinds`, that a file may have which is replaced
    told: str = ""  # of a file without a kind, what the name of its kind begins with; empty: of a text


SPLATS = OutputType("splats", (".ply", ".splat", ".spz"), "splats")
PLY = OutputType("a PLY", (".ply",), "splats")
PNG = OutputType("a picture", (".png",), None, "a picture")
NPY = OutputType("an array", (".npy",), None, "a NumPy array")
LIFT = OutputType("a lift", (".safetensors", ".shards"), "lift")
PACK = OutputType("a feature pack", (".safetensors",), "features")
CSV = OutputType("a table", (".csv",), None)
JSON = OutputType("JSON", (".json",), None)
OUTPUTS = {
    "object": SPLATS, "coloured": PLY, "labelled": PLY, "names": JSON, "scores": NPY, "splat_labels": NPY, "csv": CSV,
    **dict.fromkeys(("mask", "attention", "overlay", "labels", "picture", "output", "worst"), PNG),
}  # by the options that name files  # fmt: skip
CONVERTED = (".sog", ".glb", ".html", ".csv", ".compressed.ply", ".splat", ".spz")  # which splat-transform writes


def free_output(path: Path, inputs: Sequence[Path], written: OutputType) -> Path:
    """An output path that can be written, and is no folder, none of the inputs and no file of another kind.

    Checked before the work, so that an hour of it is not lost over a misspelt name. A file of the kind that is
    written is replaced.

    Args:
        path: as the user gave it. inputs: of the command. written: what goes there.

    Raises:
        InvalidInput: it is one of these, its suffix is not written, or no file can be made there.
    """
    with writing(path):
        if path.is_dir():
            raise InvalidInput("output", expected="a file to write", got=f"the folder {path}")
        if any(path.exists() and source.exists() and path.samefile(source) for source in inputs):
            raise InvalidInput("output", expected="another file than the inputs", got=str(path))
        _require_suffix(path, written)
        _require_same_kind(path, written)
        folder = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
        if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
            raise InvalidInput("output", expected="a folder that can be written", got=str(folder))
    return path


def free_lift(path: Path | str, inputs: Sequence[Path]) -> Path | str:
    """The file that a lift's output begins with: itself, the index of a folder of shards, or a place elsewhere.

    Raises:
        InvalidInput: it is no `free_output`, or lies where nothing can be sent to.
    """
    from liftcore.io.remote import is_remote, require_storage
    from liftcore.io.shards import INDEX, SUFFIX

    if is_remote(path):
        require_storage(str(path))
        return path
    file = Path(path)
    return free_output(file / INDEX, inputs, JSON) if file.suffix == SUFFIX else free_output(file, inputs, LIFT)


def free_outputs(files: Mapping[str, Path], inputs: Sequence[Path]) -> None:
    """Several outputs, by the options that name them.

    Raises:
        InvalidInput: one of them is no `free_output`, or two are one file.
    """
    if len({path.absolute() for path in files.values()}) < len(files):
        named = " and ".join(f"--{name.replace('_', '-')}" for name in files)
        raise InvalidInput(named, expected="a file each", got="the same file twice")
    for name, path in files.items():
        free_output(path, inputs, OUTPUTS[name])


def _require_suffix(path: Path, written: OutputType) -> None:
    name = path.name.lower()
    if name.endswith(written.suffixes) and not name.endswith(".compressed.ply"):
        return
    hint = ""
    if ".ply" in written.suffixes and name.endswith(CONVERTED):
        stem = path.name[: -len(next(suffix for suffix in CONVERTED if name.endswith(suffix)))]
        hint = f"write {stem}.ply, and convert it: npx @playcanvas/splat-transform {stem}.ply {path.name}"
    ends = " or ".join(written.suffixes)
    raise InvalidInput("output", expected=f"a name of {written.name}, ending in {ends}", got=str(path), hint=hint)


def _require_same_kind(path: Path, written: OutputType) -> None:
    from liftcore.io.kinds import identify

    if not path.is_file() or path.stat().st_size == 0:
        return
    found = identify(path)
    fits = found.kind == written.kind if written.kind else found.kind is None and found.name.startswith(written.told)
    if not fits:
        expected = f"a new file, or one of {written.name} to replace"
        hint = "name another file, or remove that one first"
        raise InvalidInput("output", expected=expected, got=f"{path}, which is {found.name}", hint=hint)


@contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Say which output failed, and why, when the disk is full or the folder is not for us to write.

    Raises:
        InvalidInput: the operating system refused.
    """
    try:
        yield
    except OSError as error:
        got = f"{path} ({error.strerror or error})"
        raise InvalidInput("output", expected="a file that can be written", got=got) from None


def _entries(document: Mapping[str, Any]) -> Iterable[str]:
    width = max((len(str(key)) for key in document), default=0)
    for key, value in document.items():
        if key == "warnings":
            yield from (f"warning: {warning}" for warning in value)
        else:
            yield f"{str(key).replace('_', ' '):<{width}}  {shown(value)}"


def shown(value: Any) -> str:
    """A value in short, for people."""
    if isinstance(value, float):
        is_large = LARGE <= abs(value) < math.inf
        return f"{value:.{min(MOST_DIGITS, 4 + int(math.log10(abs(value)))) if is_large else 6}g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_nested(item)}" for key, item in value.items()) or "-"
    if isinstance(value, list | tuple):
        more = [f"... ({len(value)})"] if len(value) > SHOWN_ITEMS else []
        return ", ".join([*map(_nested, value[:SHOWN_ITEMS]), *more]) or "-"
    return "-" if value is None or value == "" else str(value)


def _nested(value: Any) -> str:
    return f"({shown(value)})" if isinstance(value, Mapping | list | tuple) else shown(value)


def folders_of(views: Iterable[str]) -> list[str]:
    """The folders that are part of names like ``camA/000``, sorted."""
    return sorted({view.rpartition("/")[0] for view in views if "/" in view})


def told_folders(folders: Sequence[str]) -> list[str]:
    """A line about them, if there are any."""
    shown = ", ".join(folders[:SHOWN_FOLDERS]) + (" ..." if len(folders) > SHOWN_FOLDERS else "")
    return [f"  of sub-folders, whose names are part of their views': {shown}"] if folders else []
