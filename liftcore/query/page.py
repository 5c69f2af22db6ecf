"""A lift on the service's page, from Python: what is in memory lies in a temporary folder while it is shown."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.errors import InvalidInput, Unavailable
from liftcore.values.lift_file import camera_input, found_input, input_file, save_lift

if TYPE_CHECKING:
    from collections.abc import Mapping

    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats
    from liftcore.values.lift import InputFile, Lift, LiftMetadata

LAST_PORT = 65_535
ENDING_SECONDS = 10.0  # for a server that was interrupted


def require_service() -> None:
    """The library knows neither HTTP nor the service's database: they are another package.

    Raises:
        Unavailable: it is not installed.
    """
    if find_spec("service") is None:
        raise Unavailable("the page", expected="the package 'service'", got="an installation without it")


def show(
    lift: Lift, splats: Splats | None, cameras: Mapping[str, Camera] | None, *, port: int, browser: bool
) -> None:
    """Serve a lift until Ctrl-C: `LiftResult.show`."""
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port <= LAST_PORT:
        expected = f"a whole number in 0..{LAST_PORT}, 0 for a free one"
        raise InvalidInput("port", expected=expected, got=repr(port)[:80])
    require_service()
    with tempfile.TemporaryDirectory(prefix="splatlift-show-", ignore_cleanup_errors=True) as folder:
        inputs = {
            "splats": _splats_file(lift, splats, Path(folder)),
            "cameras": _cameras_file(lift.metadata, cameras, Path(folder)),
        }
        path = Path(folder, "lift.safetensors")
        save_lift(replace(lift.cpu(), metadata=lift.metadata.model_copy(update=inputs)), path)
        command = [sys.executable, "-m", "service.view", str(path), "--port", str(port)]
        command += ["--lent", folder, *["--no-browser"] * (not browser)]  # a notebook's kernel may be killed
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            try:
                for line in server.stdout:
                    print(line, end="", flush=True)  # into a notebook's cell, too
            except KeyboardInterrupt:  # which the server heard as well, or will now
                server.terminate()
                with suppress(subprocess.TimeoutExpired):
                    server.wait(ENDING_SECONDS)
                server.kill()
                return
        if server.returncode:
            got = f"one that ended with status {server.returncode}; what it said stands above"
            raise Unavailable("the page", expected="a server that starts", got=got)


def _splats_file(lift: Lift, splats: Splats | None, folder: Path) -> InputFile:
    if splats is None:
        return _remembered("splats", lift.metadata)
    from liftcore.io.splats import write_splats

    lift.require_splats(splats)
    write_splats(folder / "splats.ply", splats)
    return input_file(folder / "splats.ply")


def _cameras_file(metadata: LiftMetadata, cameras: Mapping[str, Camera] | None, folder: Path) -> InputFile:
    there = found_input("cameras", metadata.cameras, metadata, None) if metadata.cameras.path else None
    if cameras is None or there is not None:  # a file knows lenses and panoramas, too
        return _remembered("cameras", metadata)
    from liftcore.io.transforms import transforms_of

    (folder / "cameras.json").write_text(json.dumps(transforms_of(cameras)), encoding="utf-8")
    return camera_input(folder / "cameras.json")


def _remembered(role: str, metadata: LiftMetadata) -> InputFile:
    remembered: InputFile = getattr(metadata, role)
    found = found_input(role, remembered, metadata, None) if remembered.path else None
    if found is None:
        got = f"nothing, and they are not at {remembered.path}" if remembered.path else "nothing, of a lift in memory"
        raise InvalidInput(role, expected=f"the {role} of the lift", got=got, hint=f"give show({role}=...)")
    return remembered
