"""Shared parts of the commands' parsers: one line for invalid arguments, types of values, and common options."""

from __future__ import annotations

import argparse
import json
import textwrap
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Self, Union, get_args, get_origin

from liftcore.errors import InvalidInput, InvalidQuery, SplatliftError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from liftcore import Scene, TextEncoder, WorldFrame
    from liftcore.models import Body

BAD_INPUT = 2
ORDER = ("splats", "cameras", "features")
ROLES = (*ORDER, "lift", "table")  # arguments of files of that kind
ORDERED = ("lift", "plan", "check", "tradeoff")  # commands that take splats, cameras and features
MAX_DIGITS = 100  # of a whole number, with zeros before it
PRESETS = "default, row-sum, tikhonov, argmax or top-k"


@contextmanager
def option_errors(option_names: Mapping[str, str]) -> Iterator[None]:
    """Rename arguments in errors of the library to options of the command, and ``NAME=`` in their hints."""
    try:
        yield
    except SplatliftError as error:
        hint = error.hint
        for name, option in option_names.items():
            hint = hint.replace(name, option) if name.endswith("=") else hint
        argument = option_names.get(error.argument, error.argument)
        raise type(error)(argument, expected=error.expected, got=error.got, hint=hint) from None


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line and exit status 2, as other invalid input."""

    last = ""  # an optional argument, which may come after options
    fill: Callable[[], None] | None = None  # adds the options at their first use

    def add_options(self) -> Self:
        """Add the options if they are missing, and return the parser."""
        fill, self.fill = self.fill, None
        if fill is not None:
            fill()
        return self

    def format_help(self) -> str:
        """Return the help: the first line has what is required alone, and each option has a line."""
        self.add_options()
        required = [action for action in self._actions if action.required or not action.option_strings]
        words = [*self.prog.split(), "[options]", *map(_usage_of, required)]
        self.usage = " ".join(filter(None, words))
        # Wide enough for the longest options of most commands.
        self.formatter_class = partial(argparse.HelpFormatter, max_help_position=30)
        return super().format_help()

    def parse_known_args(  # pyright: ignore[reportIncompatibleMethodOverride]: it has overloads
        self, args: Any = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        """Parse with the last argument at any position: argparse ignores it after an option."""
        self.add_options()
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


def _usage_of(action: argparse.Action) -> str:
    """Return the words of a required argument."""
    name = str(action.metavar or action.dest)
    values = {"?": f"[{name}]", "*": f"[{name} ...]", "+": f"{name} [...]"}.get(str(action.nargs), name)
    return " ".join((*action.option_strings[:1], values))


def wrong_kind_error(options: argparse.Namespace) -> InvalidInput | None:
    """Return the error of the first argument with a file of the wrong kind, None if there is none.

    The hint about the order is added only if another argument has a file of the right kind.
    """
    from liftcore.cli.reply import paths_of
    from liftcore.files import identify, wrong_kind

    paths = {name: paths_of(getattr(options, name, None)) for name in ROLES}
    for name in ROLES:
        is_ordered = options.command in ORDERED and name in ORDER
        argument = name.upper() if is_ordered or name == "lift" else f"--{name}"
        for path in paths[name]:
            error = wrong_kind(path, name, InvalidInput, expected=f"{name} as {argument}")
            if error is None:
                continue
            other_kinds = (identify(path).kind for other in ORDER if other != name for path in paths[other])
            if is_ordered and name in other_kinds:
                hint = "the order is SPLATS CAMERAS FEATURES"
                error = InvalidInput(error.argument, expected=error.expected, got=error.got, hint=hint)
            return error
    return None


def shared_options() -> Parser:
    """Return the parent of every command's parser: ``--json`` and ``--debug``."""
    shared = Parser(add_help=False)
    shared.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    shared.add_argument("--debug", action="store_true", help="show the traceback of internal errors")
    return shared


def add_sources(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of splats, cameras and feature packs."""
    parser.add_argument("splats", type=Path, help="trained splats, of any format")
    parser.add_argument("cameras", type=Path, help="COLMAP, transforms.json or cameras.json")
    parser.add_argument("features", type=Path, nargs="+", help="feature packs (.safetensors)")


def add_settings(parser: Parser) -> None:
    """Add the options of the settings of a lift."""
    parser.add_argument("--preset", metavar="NAME", help=PRESETS)
    parser.add_argument("--quality", metavar="NAME", help="exact, balanced, fast or draft")
    parser.add_argument("--device", metavar="NAME", help="auto, cpu or cuda")
    add_set(parser)
    parser.add_argument("--settings", action=ListSettings, nargs=0, help="list all settings, and exit")
    add_threads(parser)


def add_set(parser: argparse.ArgumentParser) -> None:
    """Add the option of single settings."""
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one setting of a lift")


def add_threads(parser: argparse.ArgumentParser) -> None:
    """Add the option of the number of threads."""
    parser.add_argument("--threads", type=count, metavar="N", help="default: the number of cores")


class ListSettings(argparse.Action):
    """Print all settings of a lift in groups, with defaults and descriptions, and exit."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from liftcore import LiftSettings

        defaults = LiftSettings.of().model_dump(mode="json")
        for group, names in LiftSettings.groups.items():
            print(group)
            for name in names:
                meaning = (LiftSettings.model_fields[name].description or "").replace("`", "")
                default = json.dumps(defaults[name]).strip('"')
                print(
                    textwrap.fill(f"{name}={default}: {meaning}", 98, initial_indent="  ", subsequent_indent="    ")
                )
        parser.exit()


def add_fields(
    parser: argparse.ArgumentParser, model: type[Body], names: Iterable[str], overrides: Mapping[str, dict[str, Any]]
) -> None:
    """Add an option for each field of a model, with its description and type.

    Args:
        names: of the fields. overrides: keywords of `add_argument` for some fields, instead of those of the field;
            ``flag`` is the name of the option.
    """
    for name in names:
        field = model.model_fields[name]
        keywords: dict[str, Any] = {"help": field.description, "default": field.default}
        union = get_args(field.annotation) if get_origin(field.annotation) in (Union, UnionType) else ()
        parts = [get_args(part)[0] if get_origin(part) is Annotated else part for part in union or [field.annotation]]
        if get_origin(parts[0]) is list:
            keywords |= {"action": "append", "default": [], "metavar": "TEXT"}
        elif get_origin(parts[0]) is Literal and not union:
            keywords |= {"choices": get_args(parts[0])}
        elif int in parts:
            keywords |= {"type": whole_number, "metavar": "N"}
        else:
            keywords["metavar"] = name[0].upper()
        keywords |= overrides.get(name, {})
        flag = keywords.pop("flag", f"--{name.replace('_', '-')}")
        keywords |= {"dest": name} if flag.startswith("-") else {}
        parser.add_argument(flag, **keywords)


def add_encoder(parser: argparse.ArgumentParser) -> None:
    """Add the options of the text encoder."""
    words = parser.add_mutually_exclusive_group()
    words.add_argument("--table", type=Path, metavar="FILE", help="precomputed text embeddings")
    words.add_argument("--encoder", metavar="NAME", help="of texts; default: that of the lift's text space")


def add_lift(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a lift and the paths of its splats and cameras."""
    parser.add_argument("lift", type=Path, help="a lift (.safetensors)")
    add_splats(parser)
    parser.add_argument("--cameras", type=Path, metavar="PATH", help="its cameras; default: as recorded")


def add_splats(parser: argparse.ArgumentParser) -> None:
    """Add the option of the path of a lift's splats."""
    parser.add_argument("--splats", type=Path, metavar="FILE", help="its splats; default: as recorded")


def add_world(parser: argparse.ArgumentParser) -> None:
    """Add the options of the up direction and the length of a unit."""
    parser.add_argument("--up", type=float, nargs=3, metavar=("X", "Y", "Z"), help="default: from the files")
    parser.add_argument("--metres-per-unit", type=float, metavar="M", help="default: from the files")


def world_of(options: argparse.Namespace) -> WorldFrame:
    """Return the frame of the splats from the options."""
    from liftcore import WorldFrame

    with option_errors({"up": "--up", "metres_per_unit": "--metres-per-unit"}):
        return WorldFrame(up=options.up, metres_per_unit=options.metres_per_unit)


def open_lift(options: argparse.Namespace) -> Scene:
    """Open the lift of the options."""
    from liftcore import Scene

    scene = Scene(options.lift, splats=options.splats, cameras=options.cameras)
    if hasattr(options, "up"):
        scene.world = world_of(options).known_or(scene.world)
    return scene


def add_verbose(parser: argparse.ArgumentParser) -> None:
    """Add the option of all figures."""
    parser.add_argument("--verbose", action="store_true", help="print all figures")


def add_view(parser: argparse.ArgumentParser) -> None:
    """Add the options of the camera of pictures."""
    parser.add_argument("--view", metavar="NAME", help="the camera of pictures")
    parser.add_argument("--camera", type=Path, metavar="FILE", help="of others in the splats' frame")


def view_of(options: argparse.Namespace, *pictures: str) -> Any:
    """Return the camera of ``--view`` and ``--camera``: the name of a camera of the lift, another camera, or None.

    Args:
        pictures: options that need a camera.
    """
    if options.camera is None:
        picture_options = [f"--{name}" for name in pictures if getattr(options, name)]
        if options.view is None and picture_options:
            raise InvalidQuery(
                " and ".join(picture_options), expected="a view to render", got="no --view and no --camera"
            )
        return options.view
    from liftcore import read_cameras

    cameras = read_cameras(options.camera)
    if options.view is None and len(cameras) > 1:
        got = f"{len(cameras)} of them in {options.camera}"
        raise InvalidQuery("--camera", expected="one camera", got=got, hint="select one with --view NAME")
    return cameras[options.view] if options.view is not None else next(iter(cameras.values()))


def whole_number(text: str, least: int = 0, largest: int = 2**63 - 1, expected: str = "a whole number") -> int:
    """Parse a whole number that a database can store."""
    is_short = text.isascii() and text.isdigit() and len(text) < MAX_DIGITS
    if not is_short or not least <= int(text) <= largest:
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text[:80]!r}")
    return int(text)


count = partial(whole_number, least=1, expected="a whole number of one or more")


def encoder_spec(options: argparse.Namespace) -> str | None:
    """Return the specification of ``--table`` or ``--encoder``, None for the encoder of the lift."""
    return f"table:{options.table}" if options.table else options.encoder or None


def text_encoder(options: argparse.Namespace, scene: Scene, hint: str = "", *, stand_in: bool = False) -> TextEncoder:
    """Return the encoder of ``--table`` or ``--encoder``, or else the lift's words, or else that of its text space.

    Args:
        hint: other advice of the command. stand_in: as for `Scene.encoder`.
    """
    return scene.encoder(
        encoder_spec(options), hint=f"--table FILE or --encoder NAME; {hint}".rstrip("; "), stand_in=stand_in
    )
