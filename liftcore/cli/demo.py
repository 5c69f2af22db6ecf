"""``splatlift demo``: the whole job on published splat objects or a scene of yours, through the real service."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.cli.options import Parser
from liftcore.errors import Unavailable

if TYPE_CHECKING:
    from collections.abc import Iterator

LISTENING = "listening on "  # what the service says first
STOP_SECONDS = 20
LAST_WORDS = 3_000  # characters of its log, when it fails


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    cameras = "cameras.json, transforms.json, cameras.zip or sparse/0"
    holds = f"its .ply, .sog, .spz or .splat; {cameras}; a feature pack; text_table.safetensors if any"
    parser.add_argument("--scene", type=Path, metavar="DIR", help=f"a scene of yours ({holds}); else the shipped one")
    parser.add_argument(
        "--ask", action="append", default=[], metavar="TEXT", help="what to look for; may be given several times"
    )
    parser.add_argument("--pack", type=Path, metavar="FILE", help="of several feature packs of the scene, which one")
    parser.add_argument("--out", type=Path, default=Path("demo-output"), metavar="DIR", help="of pictures and lift")


def run(options: argparse.Namespace) -> int:
    """Find the scene, run the service as a user would, and say what it found."""
    from liftcore.demo.run import show
    from liftcore.demo.scene_folder import find_scene, unpack_tabletop

    def say(line: str) -> None:
        if not options.json:
            print(line, flush=True)

    begin, out, data = time.perf_counter(), options.out, options.out / "service"
    out.mkdir(parents=True, exist_ok=True)
    if options.scene is None:
        say("12 published splat objects on a table (sources: scene/LICENCES.md), with CLIP's vectors of words.")
    folder = options.scene or unpack_tabletop(out / "scene")
    subject = find_scene(folder, options.ask, out / "scene", options.pack)
    if subject.other_packs:
        others = ", ".join(subject.other_packs)
        say(f"Features are those of {subject.features.name}; --pack takes others that are here: {others}.")
    with serving(data, subject.encoder, out / "service.log") as url:
        say(f"The service listens on {url}.")
        report = show(subject, url, out, say)
    report |= {"seconds": round(time.perf_counter() - begin, 1), "out": str(out.resolve())}
    report["lift_file"] = str((data / "lifts" / f"{report['lift']}.safetensors").resolve())
    say(f"Pictures are in {report['out']}. All of it took {report['seconds']:.0f} s.")
    say(f"The lift is {report['lift_file']}")
    if options.json:
        print(json.dumps(report))
    return 0


@contextmanager
def serving(data: Path, encoder: str, log: Path) -> Iterator[str]:
    """``splatlift serve`` on a free port while the block runs; its address.

    Args:
        data: the service's directory. encoder: its text encoder. log: where what it says goes.

    Raises:
        Unavailable: the service does not start; the message holds the end of its log.
    """
    options = ["--port", "0", "--data", str(data), "--encoder", encoder]
    command = [sys.executable, "-m", "liftcore.cli", "serve", *options]
    with (
        log.open("wb") as told,
        subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=told, text=True) as server,
    ):
        try:
            said = server.stdout.readline() if server.stdout else ""
            if said.startswith(LISTENING):
                yield said.removeprefix(LISTENING).strip()
        except BaseException:
            print(f"--- the service's last words ---\n{_last_words(log)}", file=sys.stderr)
            raise
        finally:
            server.terminate()
            try:
                server.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                server.kill()
    if not said.startswith(LISTENING):
        got = f"an early end; its last words: {_last_words(log)}"
        raise Unavailable("service", expected="a service that starts", got=got)


def _last_words(log: Path) -> str:
    return log.read_text(errors="replace")[-LAST_WORDS:].strip() or "not a word"
