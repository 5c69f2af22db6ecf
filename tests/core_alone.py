"""What the core does without any extra: read, lift, save, ask with a table, render.

    python tests/core_alone.py [--block] [--no-linux]

In an environment that has the wheel alone, no folder of this checkout is imported but the tiny scene's file.
``--block`` refuses the packages of all extras, for environments that have them; ``--no-linux`` takes away the calls
and files that Linux alone has, of which macOS has others or none.
"""

import os
import sys
import tempfile
from argparse import ArgumentParser
from importlib.abc import MetaPathFinder
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any
from unittest import mock

EXTRAS = (
    *("fastapi", "fastapi_offline", "starlette", "uvicorn", "cachetools", "pydantic_settings", "httpx"),
    *("prometheus_client", "open_clip", "timm", "torchvision", "matplotlib", "ray", "pxr", "sentence_transformers"),
)
LINUX = ("sched_getaffinity", "posix_fallocate")
SYSTEM = ("/proc", "/sys")


class Blocked(MetaPathFinder):
    """Packages that are not there."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name.partition(".")[0] in EXTRAS:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def leave_linux() -> None:
    """Take away what other systems lack."""
    for name in LINUX:
        delattr(os, name)
    opened = os.open

    def refuse(path: Any, *arguments: Any, **more: Any) -> Any:
        if isinstance(path, str | Path) and str(path).startswith(SYSTEM):
            raise FileNotFoundError(2, "no such file", str(path))
        return opened(path, *arguments, **more)

    mock.patch("os.open", refuse).start()
    read = Path.read_text

    def refuse_text(path: Path, *arguments: Any, **more: Any) -> str:
        if str(path).startswith(SYSTEM):
            raise FileNotFoundError(2, "no such file", str(path))
        return read(path, *arguments, **more)

    mock.patch.object(Path, "read_text", refuse_text).start()


def tiny_scene() -> Any:
    """The module of that name, by its file."""
    spec = spec_from_file_location("tiny_scene", Path(__file__).parent / "api" / "tiny_scene.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules["tiny_scene"] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    parser = ArgumentParser(description="What the core does without any extra.")
    parser.add_argument("--block", action="store_true", help="refuse the packages of extras")
    parser.add_argument("--no-linux", action="store_true", help="take away what Linux alone has")
    options = parser.parse_args()
    if options.block:
        sys.meta_path.insert(0, Blocked())
    if options.no_linux:
        leave_linux()
    import liftcore as lc
    from liftcore.runtime.cores import cores

    scene = tiny_scene().make_scene()
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        for name in ("splats.ply", "cameras.json", "features.safetensors", "table.safetensors"):
            (folder / name).write_bytes(getattr(scene, name.partition(".")[0]))
        splats, cameras = lc.read_splats(folder / "splats.ply"), lc.read_cameras(folder / "cameras.json")
        result = lc.lift(splats, cameras, lc.read_features(folder / "features.safetensors"))
        result.save(folder / "lift.safetensors")
        opened = lc.Scene(folder / "lift.safetensors", splats=folder / "splats.ply", cameras=folder / "cameras.json")
        answer = opened.ask(lc.Query(text=["apple"]), encoder=f"table:{folder / 'table.safetensors'}")
        picture = opened.render("middle", "rgb")
        assert answer.count == 20, answer.count
        assert picture.max() > 0
        assert opened.mask(answer, "middle").any()
        check_hints(lc, folder)
    print("read, lifted, saved, asked and rendered on", cores(), "cores")


def check_hints(lc: Any, folder: Path) -> None:
    """See that what an extra is missing for names that extra."""
    from liftcore.evaluate import SceneFiles, compare_speeds

    scene = SceneFiles(folder / "splats.ply", folder / "cameras.json", (folder / "features.safetensors",))
    for package, extra, call in (
        ("open_clip", "encoders", lambda: lc.open_encoder("open_clip:ViT-B-32/openai").encode(["mug"])),
        ("fastapi", "service", lambda: lc.load_plugin("splatlift.commands", "serve")),
        ("matplotlib", "evaluate", lambda: compare_speeds(scene, budget=1.0)),
    ):
        if is_there(package):
            continue
        try:
            call()
        except lc.Unavailable as error:
            assert f"splatlift[{extra}]" in str(error), error
        else:
            raise AssertionError(f"{package} is missing, and nobody says so")


def is_there(package: str) -> bool:
    """Whether a package can be imported."""
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:
        return False


if __name__ == "__main__":
    main()
