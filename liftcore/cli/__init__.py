"""``splatlift``: the command line.

Exit status: 0; 2 for input that is the user's to mend, with one line on stderr that says what; 1 for our own
fault. With ``--json`` stdout holds one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from liftcore import __version__
from liftcore.errors import SplatliftError

if TYPE_CHECKING:
    from collections.abc import Sequence

PRESETS = "row-sum, tikhonov (default), argmax, top-k, front-mass, centre or mean"
THRESHOLDS = "auto, valley, paper, otsu, stability or a number"

KEY_QUOTAS = {
    "--max-bytes": "most bytes stored, of its assets and lifts",
    "--max-queued": "most jobs in line",
    "--max-uploads": "most uploads at once",
}
LARGEST_GREY = 65_535  # of a picture of 16 bits

BAD_INPUT = 2
OUR_FAULT = 1
INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """Argument errors are bad input like any other: one line, exit 2."""

    last = ""  # the argument that may be left out, and then come after options

    def parse_known_args(  # pyright: ignore[reportIncompatibleMethodOverride]: it has overloads
        self, args: Any = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        """Parse, with the last argument wherever it stands: argparse gives it up where an option comes before it."""
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


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; the exit status."""
    try:
        options = build_parser().parse_args(argv)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    try:
        # The command's own module, and what it needs, is loaded only now: --help stays quick.
        status = importlib.import_module(f"liftcore.cli.{options.command}").run(options)
        sys.stdout.flush()
        return status
    except SplatliftError as error:
        print(f"splatlift: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("splatlift: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # Whoever read the answer has seen enough; what is still buffered goes nowhere, without a complaint.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OUR_FAULT
    except Exception as error:
        if options.debug:
            raise
        what = " ".join(f"{type(error).__name__}: {error}".split())[:400]
        print(f"splatlift: our fault: {what} (--debug shows where)", file=sys.stderr)
        return OUR_FAULT


def build_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = _Parser(prog="splatlift", description="Lift 2D features onto trained splats and query them in words.")
    parser.add_argument("--version", action="version", version=f"splatlift {__version__}")
    shared = _Parser(add_help=False)
    shared.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    shared.add_argument("--debug", action="store_true", help="show the traceback of our own faults")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    _add_demo(commands.add_parser("demo", parents=[shared], help="the whole job, through the real service"))
    _add_serve(commands.add_parser("serve", parents=[shared], help="run the HTTP service"))
    _add_keys(commands.add_parser("keys", help="who may use the HTTP service"), shared)
    _add_lift(commands.add_parser("lift", parents=[shared], help="lift features onto splats"))
    _add_plan(commands.add_parser("plan", parents=[shared], help="what a lift would do and need"))
    _add_query(commands.add_parser("query", parents=[shared], help="find words and examples in a lift"))
    _add_pack(commands.add_parser("pack", help="make a feature pack of the field's formats"), shared)
    _add_encode(commands.add_parser("encode", parents=[shared], help="make a feature pack of images"))
    _add_inspect(commands.add_parser("inspect", parents=[shared], help="what is in a file, and what is wrong"))
    _add_evaluate(commands.add_parser("evaluate", parents=[shared], help="lifts against the field's labels"))
    _add_bench(commands.add_parser("bench", parents=[shared], help="how fast this machine lifts"))
    _add_tradeoff(commands.add_parser("tradeoff", parents=[shared], help="speed against accuracy on your scene"))
    return parser


def _add_demo(parser: argparse.ArgumentParser) -> None:
    cameras = "cameras.json, transforms.json, cameras.zip or sparse/0"
    holds = f"its .ply; {cameras}; a feature pack; text_table.safetensors if any"
    parser.add_argument("--scene", type=Path, metavar="DIR", help=f"a scene of your own ({holds}); else a still life")
    parser.add_argument(
        "--ask", action="append", default=[], metavar="TEXT", help="what to look for; may be given several times"
    )
    parser.add_argument("--out", type=Path, default=Path("demo-output"), metavar="DIR", help="of pictures and lift")


def _add_serve(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--host", help="the address to bind")
    parser.add_argument("--port", type=int, help="the port to bind; 0 picks a free one")
    parser.add_argument("--data", type=Path, metavar="DIR", help="for the database and all files")
    parser.add_argument("--encoder", metavar="NAME", help="the default text encoder")


def _add_keys(parser: argparse.ArgumentParser, shared: _Parser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=_Parser)
    create = actions.add_parser("create", parents=[shared], help="make a key and show it, once")
    create.add_argument("--name", required=True, metavar="NAME", help="whose it is, or what for")
    create.add_argument("--scopes", required=True, metavar="SCOPES", help="read,write,metrics,admin: what it may do")
    for option, limit in KEY_QUOTAS.items():
        create.add_argument(option, type=_whole, metavar="N", help=f"{limit}; else as the server is set")
    listing = actions.add_parser("list", parents=[shared], help="all keys, without their secrets")
    revoke = actions.add_parser("revoke", parents=[shared], help="end a key; what it made stays, for admins")
    revoke.add_argument("id", metavar="ID", help="as keys list shows it")
    for action in (create, listing, revoke):
        action.add_argument("--data", type=Path, metavar="DIR", help="the service's directory")


def _add_lift(parser: argparse.ArgumentParser) -> None:
    _add_sources(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="LIFT", help="the lift to write")
    _add_settings(parser)
    parser.add_argument("--explain", action="store_true", help="print the plan before the work")
    goes_on = "a killed lift goes on from there, and one of the same regions with other features walks none again"
    parser.add_argument("--checkpoint", type=Path, metavar="DIR", help=f"keep walked views there: {goes_on}")
    parser.add_argument("--threads", type=_count, metavar="N", help="else as many as there are cores")


def _add_plan(parser: argparse.ArgumentParser) -> None:
    _add_sources(parser)
    _add_settings(parser)
    parser.add_argument("--threads", type=_count, metavar="N", help="of the lift; else as many as there are cores")


def _add_sources(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("splats", type=Path, help="trained splats (.ply)")
    parser.add_argument("cameras", type=Path, help="COLMAP folder or .zip, transforms.json or cameras.json")
    parser.add_argument("features", type=Path, nargs="+", help="feature packs (.safetensors)")


def _add_settings(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--preset", metavar="NAME", help=f"a published choice of weights: {PRESETS}")
    parser.add_argument("--speed", metavar="NAME", help="the dial: exact, balanced, fast or draft")
    _add_device(parser)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one setting")


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", metavar="NAME", help="what walks and solves: auto, cpu or cuda")


def _add_tradeoff(parser: argparse.ArgumentParser) -> None:
    _add_sources(parser)
    parser.add_argument("--budget", type=_seconds, default=600.0, metavar="SECONDS", help="what it may take; 600")
    parser.add_argument("-o", "--out", type=Path, default=Path("tradeoff"), metavar="DIR", help="of chart and table")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of all runs")
    parser.add_argument("--labels", type=Path, metavar="MASKS", help="VIEW/mask [h, w], numbers of classes")
    parser.add_argument("--table", type=Path, metavar="FILE", help="text embeddings of the classes")
    parser.add_argument("--classes", nargs="+", default=[], metavar="WORD", help="the classes, from number 0 on")
    parser.add_argument("--threads", type=_count, metavar="N", help="else as many as there are cores")


def _add_query(parser: _Parser) -> None:
    parser.last = "text"
    parser.add_argument("lift", type=Path, help="a lift (.safetensors)")
    parser.add_argument("text", nargs="?", help="what to look for, in quotes; may be left out beside --like")
    like = "VIEW:x,y (a pixel), region:VIEW:LEVEL:ID, splat:J or a vector FILE.npy; may be given several times"
    parser.add_argument("--like", action="append", default=[], metavar="EXAMPLE", help=f"more of this: {like}")
    parser.add_argument("--unlike", action="append", default=[], metavar="EXAMPLE", help="less of that, likewise")
    words = parser.add_mutually_exclusive_group()
    words.add_argument("--table", type=Path, metavar="FILE", help="precomputed text embeddings")
    words.add_argument(
        "--encoder", metavar="NAME", help="minilm, open_clip:MODEL/TAG, open_clip:MODEL@FILE or table:FILE"
    )
    _add_negative(parser, ", so TEXT goes before it")
    parser.add_argument("--threshold", default="auto", metavar="T", help=THRESHOLDS)
    parser.add_argument("--instances", type=_count, metavar="N", help="how many there are, if you know")
    keep = "of what was found, all or the largest alone: in the mask, in --object and in --objects"
    parser.add_argument("--keep", choices=("all", "largest"), default="all", help=keep)
    parser.add_argument("--top", type=_count, default=0, metavar="N", help="name the best N splats")
    parser.add_argument("--objects", action="store_true", help="name the things found, with their places and boxes")
    parser.add_argument("--view", metavar="NAME", help="the camera to see the answer from")
    parser.add_argument("--mask", type=Path, metavar="PNG", help="write the mask of the view")
    parser.add_argument("--attention", type=Path, metavar="PNG", help="write the attention map of the view")
    parser.add_argument("--scores", type=Path, metavar="NPY", help="write the scores [P], float32")
    parser.add_argument("--object", type=Path, metavar="PLY", help="write the splats that were found, and no others")
    parser.add_argument("--coloured", type=Path, metavar="PLY", help="write all splats, coloured by their scores")


def _add_negative(parser: argparse.ArgumentParser, order: str = "") -> None:
    competitors = f"texts to compete with: all up to the next option{order}; may be given several times"
    parser.add_argument("--negative", nargs="+", action="extend", default=[], metavar="WORD", help=competitors)


def _add_pack(parser: argparse.ArgumentParser, shared: _Parser) -> None:
    formats = parser.add_subparsers(dest="format", required=True, metavar="FORMAT", parser_class=_Parser)
    langsplat = formats.add_parser("langsplat", parents=[shared], help="IMG_s.npy and IMG_f.npy")
    arrays = formats.add_parser("npy", parents=[shared], help="IMG.npy, a dense map a view")
    arrays.add_argument("--layout", choices=("hwc", "chw"), default="hwc", help="the order of the axes")
    masks = formats.add_parser(
        "masks", parents=[shared], help="IMG.npy, a vector a mask, with IMG.json (SAM's), IMG_masks.npy or IMG.png"
    )
    masks.add_argument(
        "--unlabelled",
        type=_grey,
        default=0,
        metavar="VALUE",
        help="of label pictures, the value that means no mask: 0, and value 1 is of the first vector; with another "
        "(255) value 0 is of the first",
    )
    space = (
        "the text encoder whose words lie in the space of the features, as query's --encoder names it "
        "(open_clip:ViT-B-32/openai): query opens it where no encoder is given, and a service takes the one that it "
        "has under that name; 'none': no text encoder shares it, so a lift is asked by example. Packs of one lift "
        "must agree"
    )
    unit = "say that the vectors are unit vectors, or are not; this changes none of them"
    for command in (langsplat, arrays, masks):
        command.add_argument("folder", type=Path, help="the folder of the files")
        command.add_argument("-o", "--output", type=Path, required=True, metavar="PACK", help="the pack to write")
        command.add_argument("--encoder-name", metavar="NAME", help="the 2D encoder that made the features")
        command.add_argument("--text-space", metavar="NAME", help=space)
        command.add_argument("--normalised", action=argparse.BooleanOptionalAction, help=unit)


def _add_encode(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("images", type=Path, nargs="+", help="images, or folders of them")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PACK", help="the pack to write")
    parser.add_argument(
        "--encoder",
        required=True,
        metavar="SPEC",
        help="maskclip:MODEL/TAG, clip:MODEL/TAG or timm:NAME; with weights of a file maskclip:MODEL@FILE, "
        "clip:MODEL@FILE or timm:NAME@FILE",
    )
    parser.add_argument("--size", type=_count, metavar="PX", help="the images' shorter side; else the model's own")
    parser.add_argument("--batch", type=_count, default=1, metavar="N", help="images that are encoded together")
    parser.add_argument("--device", default="cpu", metavar="NAME", help="where the model runs, as torch names it")
    parser.add_argument(
        "--normalised", action=argparse.BooleanOptionalAction, default=True, help="unit vectors, or as they come"
    )


def _add_inspect(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, help="splats, cameras, features, a lift, masks or a text table")


def _add_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", choices=("lerf-ovs", "3d-ovs"), help="whose labels")
    parser.add_argument(
        "lifts", nargs="+", metavar="LIFT", help="SCENE=LIFT, SCENE.lift.safetensors, or a folder of those"
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="the dataset, or its labels")
    words = parser.add_mutually_exclusive_group()
    words.add_argument("--table", type=Path, metavar="FILE", help="precomputed text embeddings")
    words.add_argument("--encoder", metavar="NAME", help="else the one that the lift's text space names")
    parser.add_argument("--protocol", nargs="+", choices=("P1", "P2", "P3", "own"), help="else all")
    parser.add_argument("--threshold", default="auto", metavar="T", help=f"of P2, P3 and own: {THRESHOLDS}")
    _add_negative(parser)
    parser.add_argument("--held-out", type=Path, metavar="FILE", help="the only frames to judge, a name a line")


def _add_bench(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="DIR",
        help="point_cloud.ply, cameras and regions or features (.safetensors); else a synthetic room",
    )
    parser.add_argument("--splats", type=_count, metavar="N", help="splats of the synthetic scene")
    parser.add_argument("--size", metavar="WxH", help="image size of the synthetic scene")
    parser.add_argument("--channels", type=_count, metavar="F", help="of the features; else 512")
    parser.add_argument("--levels", type=_count, metavar="L", help="label levels; else 4")
    parser.add_argument("--views", type=_count, metavar="N", help="at most; else 8")
    parser.add_argument("--threads", type=_count, metavar="N", help="else as many as there are cores")
    parser.add_argument("--preset", metavar="NAME", help="one of lift's presets alone; else all")
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--stages", action="store_true", help="every step of a view apart, on one thread")
    only.add_argument("--aims", action="store_true", help="the project's aims beside what this machine does")
    _add_device(parser)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected seconds, got {text!r}")
    return value


def _grey(text: str) -> int:
    value = int(text) if text.isascii() and text.isdigit() and len(text) <= 5 else LARGEST_GREY + 1
    if value > LARGEST_GREY:
        raise argparse.ArgumentTypeError(f"expected a whole number from 0 to {LARGEST_GREY}, got {text!r}")
    return value


def _count(text: str) -> int:
    value = int(text) if text.isascii() and text.isdigit() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of one or more, got {text!r}")
    return value


def _whole(text: str) -> int:
    if not (text.isascii() and text.isdigit()) or int(text) >= 2**63:
        raise argparse.ArgumentTypeError(f"expected a whole number, got {text[:80]!r}")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
