"""``splatlift view`` and ``result.show()``: show one lift on the service's page, on a local port, until Ctrl-C.

A temporary data directory holds links to the lift and to the files that it was made of: nothing is copied, and what
is deleted on the page is a link. What a lift of Python has in memory alone is written to another one beside it.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open

from liftcore.cli import Parser
from liftcore.errors import InvalidInput, InvalidLift, Unavailable
from liftcore.text import BUILT_IN
from service.commands.serve import serve
from service.process import Child, Children, end_with_parent
from service.results import add_lift
from service.settings import ServiceSettings, read_settings
from service.store import SERVICE, Store

if TYPE_CHECKING:
    from collections.abc import Mapping

    from liftcore import Camera, LiftResult, Splats

LAST_PORT = 65_535


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument("lift", type=Path, help="a lift (.safetensors), whose splats and cameras are where they were")
    parser.add_argument("--port", type=int, default=0, help="the port of this machine; 0 picks a free one")
    parser.add_argument("--no-browser", action="store_true", help="print the address, and open nothing")


def run(options: argparse.Namespace) -> int:
    """Show the lift until Ctrl-C."""
    show_file(options.lift, options.port, browser=not options.no_browser)
    return 0


def show(
    lift: LiftResult, splats: Splats | None, cameras: Mapping[str, Camera] | None, *, port: int, browser: bool
) -> None:
    """Serve a lift until Ctrl-C: `LiftResult.show`. The server ends with this process."""
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port <= LAST_PORT:
        expected = f"a whole number in 0..{LAST_PORT}, 0 for a free one"
        raise InvalidInput("port", expected=expected, got=repr(port)[:80])
    with tempfile.TemporaryDirectory(prefix="splatlift-show-", ignore_cleanup_errors=True) as folder:
        path = lift.save_scene(Path(folder), splats, cameras)
        server = Child("service.commands.view", str(path), str(port), str(int(browser)), TMPDIR=folder)
        try:
            for line in server.output:
                print(line.decode(), end="", flush=True)  # flushed for the cell of a notebook
            status = server.end()
        except KeyboardInterrupt:
            status = 0
        finally:
            server.end()
            server.close()
    if status:
        got = f"one that ended with status {status}; what it said stands above"
        raise Unavailable("the page", expected="a server that starts", got=got)


def show_file(path: Path, port: int, *, browser: bool) -> None:
    """Show the lift on a port, over a data directory that is removed with the server."""
    metadata, lift_ids = metadata_of(path), list[str]()
    with tempfile.TemporaryDirectory(prefix="splatlift-view-") as folder:

        def announce(address: str) -> None:
            page = f"{address}/?lift={lift_ids[0]}"
            print(f"{page} (Ctrl-C ends it)", flush=True)
            if browser:
                threading.Thread(target=webbrowser.open, args=(page,), daemon=True).start()

        settings = settings_of(Path(folder), port, metadata.get("text_space", ""))
        serve(settings, announce, lambda store: lift_ids.append(adopt(store, settings, path, metadata)))


def metadata_of(path: Path) -> dict[str, Any]:
    """Return the metadata of a lift file."""
    try:
        handle: Any
        with safe_open(str(path), framework="np") as handle:
            return json.loads(handle.metadata()["splatlift"])
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        got = f"another: {error!r}"[:120]
        raise InvalidLift(str(path), expected="a lift file (.safetensors)", got=got) from None


def adopt(store: Store, settings: ServiceSettings, path: Path, metadata: dict[str, Any]) -> str:
    """Add a lift and the files that it was made of to a store, by links; return the lift's id.

    Packs that moved are left out: only examples of regions need them.
    """
    packs = [("features", file) for file in metadata["features"] if Path(file["path"]).is_file()]
    children = Children()
    try:
        with store.scratch() as scratch:

            def link(kind: str, source: Path) -> tuple[Path, dict[str, Any]]:
                draft = scratch / kind
                draft.symlink_to(source.resolve())
                order = {"task": "check", "kind": kind, "file": str(source), "scratch": str(scratch), "names": {}}
                return draft, children.result_of(order, settings.check_seconds, kind)

            for kind, file in (("splats", metadata["splats"]), ("cameras", metadata["cameras"]), *packs):
                source = Path(file["path"])
                if not file["path"] or not source.exists():
                    got = "nothing there" if file["path"] else "a lift of values in memory"
                    raise InvalidLift(str(path), expected=f"its {kind} at {file['path'] or 'a path'}", got=got)
                draft, content = link(kind, source)
                store.add_asset(SERVICE, kind, draft, file["sha256"], content)
            draft, content = link("lift", path)
            return add_lift(store, SERVICE, draft, content).id
    finally:
        children.stop()


def settings_of(folder: Path, port: int, text_space: str) -> ServiceSettings:
    """Return the settings of a server for this machine only, with the encoder of the lift's text space if known.

    Spaces of encoders that ship, and those that the environment names, are answered as by any server.
    """
    settings = read_settings(data=folder, host="127.0.0.1", port=port, disk_floor_bytes=0)
    if text_space.startswith("open_clip:") and text_space not in (*BUILT_IN.values(), *settings.text_spaces):
        return settings.model_copy(update={"text_spaces": {**settings.text_spaces, text_space: text_space}})
    return settings


if __name__ == "__main__":
    end_with_parent(int(sys.argv[1]))
    show_file(Path(sys.argv[2]), int(sys.argv[3]), browser=sys.argv[4] == "1")
