"""How commands answer: one JSON object, or lines for people; and bars on stderr for somebody who watches."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from liftcore.errors import InvalidInput

SHOWN_ITEMS = 6  # of a list, for people
SHOWN_FOLDERS = 8
LARGE = 1e4  # from here on numbers show about three decimals: places in map coordinates begin alike
MOST_DIGITS = 15


def reply(document: Mapping[str, Any], *, as_json: bool, lines: Iterable[str] | None = None) -> None:
    """Print one JSON object, or else ``lines``, or else the document's entries, a line each."""
    if as_json:
        from liftcore.files import finite

        print(json.dumps(finite(document), allow_nan=False))
        return
    for line in lines if lines is not None else _entries(document):
        print(line)


OUTPUTS = {
    "object": "splats", "coloured": "ply", "labelled": "ply", "names": "json", "scores": "npy", "splat_labels": "npy",
    "csv": "csv", **dict.fromkeys(("mask", "attention", "overlay", "labels", "picture", "output"), "png"),
}  # what options that name files write  # fmt: skip


def free_outputs(files: Mapping[str, Path], inputs: Sequence[Path]) -> None:
    """Several outputs, by the options that name them.

    Raises:
        InvalidInput: one of them cannot be written (`check_output`), or two are one file.
    """
    from liftcore.files import check_output

    if len({path.absolute() for path in files.values()}) < len(files):
        named = " and ".join(f"--{name.replace('_', '-')}" for name in files)
        raise InvalidInput(named, expected="a file each", got="the same file twice")
    for name, path in files.items():
        check_output(path, inputs, OUTPUTS[name])


def write_files(files: Mapping[str, Path], exports: Mapping[str, Callable[[Path], None]]) -> dict[str, str]:
    """Write each file, in their order: what cannot be made leaves no file, and none after it."""
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


def place_of(point: tuple[float, ...]) -> str:
    """A point for people, with four digits; of map coordinates, which all begin alike, with about three decimals."""
    reach = max(map(abs, point))
    digits = 4 if reach < LARGE else 4 + int(math.log10(reach))
    return f"({', '.join(f'{value:.{digits}g}' for value in point)})"


def smoothing_line(facts: Mapping[str, Any]) -> str:
    """What smoothing did (``diagnostics["smoothing"]``), as a sentence for people."""
    reason = _choice_reason(facts["smoothness"], facts["candidates"]) if "candidates" in facts else ""
    if not facts["smoothness"]:
        return f"smoothness 0{reason}"
    moved = "not at all" if facts["moved"] is None else f"by {facts['moved']:.1%} of their length"
    by = "place and colour" if facts["colours"] else "place alone, as the splats have no colours"
    parted = facts.get("parted", 0.0)
    by += f", but where masks part them ({parted:.1%} of affinity)" if parted else ""
    return (
        f"smoothness {facts['smoothness']:g}{reason}: features moved {moved} towards their neighbours' in {by}; "
        f"{facts['filled']} splats without weight took their neighbours' "
        f"({facts['steps']} steps, {facts['residual']:.1g} of the gradient left)"
    )


def _choice_reason(chosen: float, candidates: Sequence[Mapping[str, float]]) -> str:
    """Why auto chose its lambda, as a clause."""
    if not candidates:
        return ", as there are no two halves of the views to tell what the scene gains by more"
    bits = {one["smoothness"]: one["information"] for one in candidates}
    if not chosen:
        return f", as half of the views tells no more of the other half with it ({bits[0]:.3f} bits a splat without)"
    return (
        f", by which half of the views tells {bits[chosen]:.3f} bits a splat of the other half, {bits[0]:.3f} without"
    )


def told_folders(folders: Sequence[str]) -> list[str]:
    """A line about them, if there are any."""
    shown = ", ".join(folders[:SHOWN_FOLDERS]) + (" ..." if len(folders) > SHOWN_FOLDERS else "")
    return [f"  of sub-folders, whose names are part of their views': {shown}"] if folders else []
