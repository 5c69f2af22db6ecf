"""Checks of output files before the work, so that no hour of it is lost to a misspelt name."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from liftcore.errors import InvalidInput
from liftcore.runtime.arguments import as_list, as_path, check_choice


@dataclass(frozen=True)
class OutputType:
    """A type of output file."""

    name: str  # as errors have it
    suffixes: tuple[str, ...]
    kind: str | None  # of `liftcore.io.kinds`, that a file may have which is replaced
    kind_name: str = ""  # of a file without a kind, what the name of its kind has; empty: of a file of no known kind


OUTPUT_TYPES = {
    "splats": OutputType("splats", (".ply", ".splat", ".spz", ".glb", ".usdc", ".usdz"), "splats"),
    "ply": OutputType("a PLY", (".ply",), "splats"),
    "png": OutputType("a picture", (".png",), None, "a picture"),
    "npy": OutputType("an array", (".npy",), None, "a NumPy array"),
    "lift": OutputType("a lift", (".safetensors",), "lift"),
    "pack": OutputType("a feature pack", (".safetensors",), "features"),
    "csv": OutputType("a table", (".csv",), None),
    "json": OutputType("JSON", (".json",), None, "JSON"),
}
CONVERTED = (".sog", ".html", ".csv", ".compressed.ply", ".splat", ".spz")  # which splat-transform writes


def check_output(path: Path | str, inputs: Path | str | Iterable[Path | str], kind: str) -> Path | str:
    """Check that an output can be written, and is no folder, none of the inputs and no file of another kind.

    A file of the kind that is written is replaced.

    Args:
        path: as the user gave it. inputs: files, and folders of cameras, that are read for it. kind: what goes there,
            one of OUTPUT_TYPES.
    """
    check_choice("kind", kind, OUTPUT_TYPES)
    path = as_path(path, "output")
    output = OUTPUT_TYPES[kind]
    with writing(path):
        if path.is_dir():
            raise InvalidInput("output", expected="a file to write", got=f"the folder {path}")
        if path.exists() and any(map(path.samefile, _files_of(map(Path, as_list(inputs))))):
            raise InvalidInput("output", expected="another file than the inputs", got=str(path))
        _require_suffix(path, output)
        _require_same_kind(path, output)
        folder = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
        if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
            raise InvalidInput("output", expected="a folder that can be written", got=str(folder))
    return path


def _files_of(inputs: Iterable[Path]) -> list[Path]:
    """Return the existing files of inputs; of a folder of cameras those that are read."""
    from liftcore.io.cameras import camera_source

    files = (file for source in inputs for file in (camera_source(source).files if source.is_dir() else [source]))
    return [file for file in files if file.exists()]


def _require_suffix(path: Path, output: OutputType) -> None:
    name = path.name.lower()
    if name.endswith(output.suffixes) and not name.endswith(".compressed.ply"):
        return
    hint = ""
    if ".ply" in output.suffixes and name.endswith(CONVERTED):
        stem = path.name[: -len(next(suffix for suffix in CONVERTED if name.endswith(suffix)))]
        hint = f"write {stem}.ply, and convert it: npx @playcanvas/splat-transform {stem}.ply {path.name}"
    ends = " or ".join(output.suffixes)
    raise InvalidInput("output", expected=f"a name of {output.name}, ending in {ends}", got=str(path), hint=hint)


def _require_same_kind(path: Path, output: OutputType) -> None:
    from liftcore.io.kinds import identify

    if not path.is_file() or path.stat().st_size == 0:
        return
    present = identify(path)
    is_alike = output.kind_name in present.name if output.kind_name else not present.recognised
    if not (present.kind == output.kind if output.kind else present.kind is None and is_alike):
        expected = f"a new file, or one of {output.name} to replace"
        hint = "name another file, or remove that one first"
        raise InvalidInput("output", expected=expected, got=f"{path}, which is {present.name}", hint=hint)


@contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Name the output in errors of the operating system: a full disk, a folder without permission."""
    try:
        yield
    except OSError as error:
        got = f"{path} ({error.strerror or error})"
        raise InvalidInput("output", expected="a file that can be written", got=got) from None
