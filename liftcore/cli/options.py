"""What commands' parsers share: one line for wrong arguments, kinds of values, and options that many take."""

from __future__ import annotations

import argparse
import json
import shutil
import textwrap
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Self, Union, get_args, get_origin

from liftcore.errors import InvalidInput, InvalidQuery, SplatliftError
from liftcore.files import is_remote

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from pydantic import BaseModel

    from liftcore import Scene, TextEncoder, WorldFrame

BAD_INPUT = 2
ROLES = {  # of arguments that name files: what belongs there
    "splats": "splats", "cameras": "cameras", "features": "features", "lift": "lift", "table": "table",
}  # fmt: skip
ORDER = ("splats", "cameras", "features")
ORDERED = ("lift", "plan", "check", "tradeoff")  # commands that take splats, cameras and features
PRESETS = "default, row-sum, tikhonov, argmax, top-k, front-mass, centre or mean"


@contextmanager
def renamed(names: Mapping[str, str]) -> Iterator[None]:
    """Errors of the library in the command's words: arguments by their options; in hints ``NAME=`` by its option."""
    try:
        yield
    except SplatliftError as error:
        hint = error.hint
        for name, option in names.items():
            hint = hint.replace(name, option) if name.endswith("=") else hint
        argument = names.get(error.argument, error.argument)
        raise type(error)(argument, expected=error.expected, got=error.got, hint=hint) from None


class Elsewhere(str):
    """The text of an argument that names a protocol."""


def place(text: str) -> Path | Elsewhere:
    """An argument: a path, or where a file lies elsewhere."""
    return Elsewhere(text) if is_remote(text) else Path(text)


class Parser(argparse.ArgumentParser):
    """Argument errors are bad input like any other: one line, exit 2."""

    last = ""  # the argument that may be left out, and then come after options
    fill: Callable[[], None] | None = None  # adds the options, when they are needed first
    appendix: Callable[[], str] | None = None  # what stands below the options, made when it is shown

    def filled(self) -> Self:
        """The parser with all of its options."""
        fill, self.fill = self.fill, None
        if fill is not None:
            fill()
        return self

    def format_help(self) -> str:
        self.filled()
        if self.appendix is not None:
            self.formatter_class, self.epilog = argparse.RawDescriptionHelpFormatter, self.appendix()
        return super().format_help()

    def parse_known_args(  # pyright: ignore[reportIncompatibleMethodOverride]: it has overloads
        self, args: Any = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        """Parse, with the last argument wherever it stands: argparse gives it up where an option comes before it."""
        self.filled()
        options, rest = super().parse_known_args(args, namespace)
        if not self.last or not rest or (rest[0].startswith("-") and rest[0] != "--"):
            return options, rest
        words = rest[1:] if rest[0] == "--" else rest
        if words and getattr(options, self.last) is None:
            setattr(options, self.last, words.pop(0))
        if words and not any(word.startswith("-") for word in words):
            self.error(f"unrecognized arguments: {' '.join(words)}; a text of several words is one, in quotes")
        return options, words

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {' '.join(message.split())}; see '{self.prog} --help'\n")


def misplaced(options: argparse.Namespace) -> InvalidInput | None:
    """The error of the first file that stands where another kind belongs; None where none does.

    That the order is wrong is said only where what belongs there was given elsewhere.
    """
    from liftcore.files import identify, wrong_kind

    given = {name: _paths(getattr(options, name, None)) for name in ROLES}
    for name, wanted in ROLES.items():
        is_ordered = options.command in ORDERED and name in ORDER
        argument = name.upper() if is_ordered or name == "lift" else f"--{name}"
        for path in given[name]:
            error = wrong_kind(path, wanted, InvalidInput, expected=f"{wanted} as {argument}")
            if error is None:
                continue
            others = (identify(path).kind for other in ORDER if other != name for path in given[other])
            if is_ordered and wanted in others:
                hint = "the order is SPLATS CAMERAS FEATURES"
                error = InvalidInput(error.argument, expected=error.expected, got=error.got, hint=hint)
            return error
    return None


def _paths(given: Any) -> list[Path]:
    return [path for path in (given if isinstance(given, list) else [given]) if isinstance(path, Path)]


def shared_options() -> Parser:
    """A parent of every command's parser: ``--json`` and ``--debug``."""
    shared = Parser(add_help=False)
    shared.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    shared.add_argument("--debug", action="store_true", help="show the traceback of our own faults")
    return shared


def add_sources(parser: argparse.ArgumentParser, features: str = "+", without: str = "") -> None:
    """Splats, cameras and feature packs.

    Args:
        features: how many, as argparse says it. without: what happens where there is none.
    """
    parser.add_argument("splats", type=place, help="trained splats (.ply, .splat, .spz, .sog, or a checkpoint)")
    parser.add_argument("cameras", type=place, help="COLMAP folder or .zip, transforms.json or cameras.json")
    parser.add_argument("features", type=place, nargs=features, help=f"feature packs (.safetensors){without}")


def add_settings(parser: Parser) -> None:
    """The settings of a lift."""
    parser.appendix = settings_help
    parser.add_argument("--preset", metavar="NAME", help=f"a choice of weights: {PRESETS}")
    parser.add_argument("--speed", metavar="NAME", help="the dial: exact, balanced, fast or draft")
    add_device(parser)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one setting of those below")


def settings_help() -> str:
    """All settings of a lift in groups, with their defaults and meanings, as wide as the terminal."""
    from liftcore import LiftSettings

    wrap = partial(textwrap.fill, width=shutil.get_terminal_size().columns - 2, subsequent_indent=" " * 6)
    lines = ["settings of a lift, for --set:"]
    for group, names in LiftSettings.groups().items():
        lines += ["", f"  {group}"]
        for name in names:
            field = LiftSettings.model_fields[name]
            meaning = (field.description or "").replace("`", "")
            default = json.dumps(LiftSettings.of().model_dump(mode="json")[name]).strip('"')
            lines.append(wrap(f"{name}={default}: {meaning}", initial_indent=" " * 4))
    return "\n".join(lines)


def add_device(parser: argparse.ArgumentParser) -> None:
    """Where to compute."""
    parser.add_argument("--device", metavar="NAME", help="what walks and solves: auto, cpu or cuda")


def add_fields(
    parser: argparse.ArgumentParser, model: type[BaseModel], names: Iterable[str], own: Mapping[str, dict[str, Any]]
) -> None:
    """An option a field of a model, with its description and what it takes.

    Args:
        names: of the fields. own: of some, what `add_argument` takes in place of what the field says; ``flag`` is
            the option's own name.
    """
    for name in names:
        field = model.model_fields[name]
        known: dict[str, Any] = {"help": field.description, "default": field.default}
        union = get_args(field.annotation) if get_origin(field.annotation) in (Union, UnionType) else ()
        parts = [get_args(part)[0] if get_origin(part) is Annotated else part for part in union or [field.annotation]]
        if get_origin(parts[0]) is list:
            known |= {"action": "append", "default": [], "metavar": "TEXT"}
        elif get_origin(parts[0]) is Literal and not union:
            known["choices"] = get_args(parts[0])
        elif int in parts:
            known |= {"type": whole, "metavar": "N"}
        else:
            known["metavar"] = name[0].upper()
        known |= own.get(name, {})
        flag = known.pop("flag", f"--{name.replace('_', '-')}")
        known |= {"dest": name} if flag.startswith("-") else {}
        parser.add_argument(flag, **known)


def add_encoder(parser: argparse.ArgumentParser) -> None:
    """Where the vectors of words come from."""
    words = parser.add_mutually_exclusive_group()
    words.add_argument("--table", type=Path, metavar="FILE", help="precomputed text embeddings")
    specs = "lvis, minilm, open_clip:MODEL/TAG, open_clip:MODEL@FILE or table:FILE"
    words.add_argument("--encoder", metavar="NAME", help=f"{specs}; else the one that the lift's text space names")


def add_lift(parser: argparse.ArgumentParser) -> None:
    """A lift, and where its splats and cameras are now."""
    parser.add_argument("lift", type=place, help="a lift (.safetensors)")
    add_splats(parser)
    parser.add_argument(
        "--cameras", type=place, metavar="PATH", help="its cameras, likewise; more of them may be there"
    )


def add_splats(parser: argparse.ArgumentParser) -> None:
    """Where the splats of a lift are now."""
    parser.add_argument("--splats", type=place, metavar="FILE", help="its splats; else where they were, or beside it")


def add_world(parser: argparse.ArgumentParser) -> None:
    """Which way is up, and how long a unit is."""
    against = "the direction against gravity, in the frame of the splats; else as their files say it"
    parser.add_argument("--up", type=float, nargs=3, metavar=("X", "Y", "Z"), help=against)
    parser.add_argument("--metres-per-unit", type=float, metavar="M", help="how long a scene unit is; else likewise")
    known = "in place of that: two points, and how many metres lie between them"
    parser.add_argument(
        "--distance", type=float, nargs=7, metavar=("X", "Y", "Z", "X2", "Y2", "Z2", "METRES"), help=known
    )


def world_of(options: argparse.Namespace) -> WorldFrame:
    """What the options say of the frame of the splats.

    Raises:
        InvalidInput: a direction of zero, no length above zero, or the length of a unit in two ways.
    """
    from liftcore import WorldFrame

    given: dict[str, Any] = {"up": options.up, "metres_per_unit": options.metres_per_unit}
    if options.distance is not None and options.metres_per_unit is not None:
        raise InvalidInput("--distance", expected="it or --metres-per-unit, not both", got="both")
    if options.distance is not None:
        *points, metres = options.distance
        given["distance"] = {"between": (points[:3], points[3:]), "metres": metres}
    with renamed(
        {
            "up": "--up",
            "metres_per_unit": "--metres-per-unit",
            **dict.fromkeys(("distance", "distance.between", "distance.metres"), "--distance"),
        }
    ):
        return WorldFrame(**given)


def sides_of(size: Sequence[float], unit: str) -> str:
    """Sides for people: 0.4 x 0.2 x 0.1 metres."""
    return f"{' x '.join(f'{side:.4g}' for side in size)} {unit}"


def opened_lift(options: argparse.Namespace) -> Scene:
    """The lift that the options name.

    Raises:
        InvalidLift: it is none.
    """
    from liftcore import Scene

    scene = Scene(options.lift, splats=options.splats, cameras=options.cameras)
    if hasattr(options, "up"):
        scene.world = world_of(options).known_or(scene.world)
    return scene


def add_verbose(parser: argparse.ArgumentParser) -> None:
    """More than the verdict."""
    parser.add_argument("--verbose", action="store_true", help="print all figures, not the verdict alone")


def add_view(parser: argparse.ArgumentParser) -> None:
    """The camera of pictures."""
    parser.add_argument("--view", metavar="NAME", help="the camera to see it from")
    own = "a camera that the lift need not know, in the splats' frame: a file of any format; of several, --view's"
    parser.add_argument("--camera", type=Path, metavar="FILE", help=own)


def view_of(options: argparse.Namespace, *pictures: str) -> Any:
    """What ``--view`` and ``--camera`` name: a camera of the lift by its name, another camera, or None.

    Args:
        pictures: options that need it.

    Raises:
        InvalidQuery: a picture without a view, or a file of several cameras without one.
        InvalidCameras, NotFound: the file holds none, or none of that name.
    """
    named = " and ".join(f"--{name}" for name in pictures)
    if options.camera is None:
        if options.view is None and any(getattr(options, name) for name in pictures):
            raise InvalidQuery(named, expected="a view to see them from", got="no --view and no --camera")
        return options.view
    from liftcore import read_cameras

    cameras = read_cameras(options.camera)
    if options.view is None and len(cameras) > 1:
        got = f"{len(cameras)} of them in {options.camera}"
        raise InvalidQuery("--camera", expected="one camera", got=got, hint="--view NAME says which one")
    return cameras[options.view] if options.view is not None else next(iter(cameras.values()))


def count(text: str) -> int:
    """A whole number of one or more."""
    value = int(text) if text.isascii() and text.isdigit() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of one or more, got {text!r}")
    return value


def whole(text: str) -> int:
    """A whole number that a database holds."""
    if not (text.isascii() and text.isdigit()) or int(text) >= 2**63:
        raise argparse.ArgumentTypeError(f"expected a whole number, got {text[:80]!r}")
    return int(text)


def text_encoder(options: argparse.Namespace, scene: Scene, hint: str = "", *, stand_in: bool = False) -> TextEncoder:
    """The encoder that ``--table`` or ``--encoder`` names, else the lift's own words, else that of its text space.

    Args:
        hint: what else the command can do. stand_in: as `Scene.encoder` has it.

    Raises:
        InvalidQuery, Unavailable: as `Scene.encoder` has it.
    """
    named = f"table:{options.table}" if options.table else options.encoder or None
    return scene.encoder(named, hint=f"--table FILE or --encoder NAME; {hint}".rstrip("; "), stand_in=stand_in)
