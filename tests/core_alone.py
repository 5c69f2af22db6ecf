"""Run the core without any extra: read, plan, lift, save, ask with a table, render, export.

    python tests/core_alone.py [--block]

In an environment that has the wheel alone, no folder of this checkout is imported but the tiny scene's file.
``--block`` refuses the packages of all extras, for environments that have them.
"""

import gc
import sys
import tempfile
from argparse import ArgumentParser
from importlib.util import find_spec
from pathlib import Path
from runpy import run_path
from typing import Any

EXTRAS = (
    *("fastapi", "fastapi_offline", "starlette", "uvicorn", "pydantic_settings", "httpx"),
    *("prometheus_client", "open_clip", "timm", "torchvision", "matplotlib", "ray", "pxr"),
    *("hdbscan", "sklearn"),
)


def main() -> None:
    parser = ArgumentParser(description="What the core does without any extra.")
    parser.add_argument("--block", action="store_true", help="refuse the packages of extras")
    options = parser.parse_args()
    if options.block:
        sys.modules.update(dict.fromkeys(EXTRAS))  # pyright: ignore - None: no package of that name is there
    import liftcore as lc
    from liftcore.runtime.cores import cores

    scene = run_path(str(Path(__file__).parent / "tiny_scene.py"))["make_scene"]()
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        for name in ("splats.ply", "cameras.json", "features.safetensors", "table.safetensors"):
            (folder / name).write_bytes(getattr(scene, name.partition(".")[0]))
        lift_and_ask(lc, folder)
        lift_in_blocks(lc, folder)
        hold_in_files()
        check_hints(lc, folder)
        assert "triton" not in sys.modules, "only a lift on a GPU needs it"
        gc.collect()  # Windows removes no file that a lift still maps
    print("read, planned, lifted, saved, asked, rendered and exported on", cores(), "cores")


def lift_and_ask(lc: Any, folder: Path) -> None:
    """Plan, lift, save, ask and export."""
    splats, cameras = lc.read_splats(folder / "splats.ply"), lc.read_cameras(folder / "cameras.json")
    features = lc.read_features(folder / "features.safetensors")
    assert lc.plan(splats, cameras, features).views
    lc.lift(splats, cameras, features).save(folder / "lift.safetensors")
    scene = lc.Scene(folder / "lift.safetensors", splats=folder / "splats.ply", cameras=folder / "cameras.json")
    answer = scene.ask(lc.Query(text=["apple"]), encoder=f"table:{folder / 'table.safetensors'}")
    assert answer.count == 20, answer.count
    assert scene.render("middle", "rgb").max() > 0
    assert scene.mask(answer, "middle").any()
    for name in ("apple.ply", "apple.glb", "apple.spz"):
        scene.export(folder / name, answer)
    assert lc.read_splats(folder / "apple.glb").count == answer.count
    check_replacing(lc, folder)


def check_replacing(lc: Any, folder: Path) -> None:
    """See that a lift is replaced while it is open, or that words say why not."""
    stored = lc.load_lift(folder / "lift.safetensors")
    try:
        stored.save(folder / "lift.safetensors")
    except lc.Unavailable as error:
        assert sys.platform == "win32" and "open" in str(error), error
    assert lc.load_lift(folder / "lift.safetensors").features.equal(stored.features)


def lift_in_blocks(lc: Any, folder: Path) -> None:
    """Lift views of an iterator by pieces in files."""
    splats, cameras = lc.read_splats(folder / "splats.ply"), lc.read_cameras(folder / "cameras.json")
    features = lc.read_features(folder / "features.safetensors")
    expected = lc.lift(splats, cameras, features)
    pieces = lc.lift(splats, cameras, iter(features.items()), engine=lc.LocalEngine())
    assert pieces.features.equal(expected.features)


def hold_in_files() -> None:
    """Make an array that memory has no room for, and look at this machine."""
    import torch

    from liftcore.evaluate.hardware import hardware, peak_memory
    from liftcore.runtime.memory import zeros

    rows = zeros((1 << 12, 1 << 8), torch.float32, name="rows", in_file=True)
    rows += 1
    assert rows.sum() == rows.numel()
    assert hardware()["cpu"]
    assert sys.platform == "win32" or peak_memory()


def check_hints(lc: Any, folder: Path) -> None:
    """See that what an extra is missing for names that extra."""
    from liftcore.evaluate import SceneFiles, compare_speeds

    scene = SceneFiles(folder / "splats.ply", folder / "cameras.json", (folder / "features.safetensors",))
    inputs = (lc.read_splats(scene.splats), lc.read_cameras(scene.cameras), lc.read_features(*scene.features))
    for package, extra, call in (
        ("open_clip", "encoders", lambda: lc.open_encoder("open_clip:ViT-B-32/openai").encode(["mug"])),
        ("fastapi", "service", lambda: lc.load_command("serve")),
        ("matplotlib", "evaluate", lambda: compare_speeds(scene, budget=1.0)),
        ("hdbscan", "aggregation", lambda: lc.lift(*inputs, aggregation=True)),
    ):
        if find_spec(package) is not None:
            continue
        try:
            call()
        except lc.Unavailable as error:
            is_foreign = extra == "service" and sys.platform != "linux"
            assert ("Linux" if is_foreign else f"splatlift[{extra}]") in str(error), error
        else:
            raise AssertionError(f"{package} is missing, and nobody says so")


if __name__ == "__main__":
    main()
