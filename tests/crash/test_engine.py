"""A job of the service in blocks: killed, it goes on from finished ones; what needs all regions is lifted whole."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

import liftcore as lc
from liftcore.features.pack import write_pack
from liftcore.io.ply import write_splats
from liftcore.io.transforms import transforms_of
from service.jobs.child import Reporter
from service.jobs.lifting import lift_as_ordered
from tests.scenes import look_at, random_splats

ROOT = Path(__file__).parents[2]
VIEWS = 20  # three blocks
KILLED = """if True:
    import io, json, os, signal, sys
    from service.jobs.child import Reporter
    from service.jobs.lifting import lift_as_ordered

    class Deadly(Reporter):
        def __call__(self, stage, done, total, unit):
            if (stage, done) == ("geometry", 16):
                os.kill(os.getpid(), signal.SIGKILL)

    lift_as_ordered(json.loads(sys.argv[1]), Deadly(io.BytesIO()))
"""


def order_of(folder: Path, **settings: Any) -> dict[str, Any]:
    """A scene of twenty views as files, and the order of its lift on the local engine."""
    rng = np.random.default_rng(2)
    names = [f"v{number:02}" for number in range(VIEWS)]
    cameras = {name: look_at(name, rng.normal((0, 0, -4), 1), 32, 24, 30.0) for name in names}
    write_splats(random_splats(3, 2000, spread=2.0), folder / "s.ply")
    (folder / "c.json").write_text(json.dumps(transforms_of(cameras)))
    maps = {name: lc.Regions(rng.integers(-1, 6, (1, 12, 16)), np.eye(6, dtype=np.float32)) for name in names}
    write_pack(folder / "f.safetensors", maps, {})
    files = {str(folder / name): name for name in ("s.ply", "c.json", "f.safetensors")}
    splats, cameras_file, pack = files
    return {
        "splats": splats, "cameras": cameras_file, "features": [pack], "settings": settings, "threads": 1,
        "work": str(folder / "work"), "checkpoint_seconds": 0, "engine": "local", "ray_address": None,
        "output": str(folder / "lift.safetensors"), "file_names": files, "names": files,
    }  # fmt: skip


def test_job_in_blocks_that_is_killed_goes_on_from_them(tmp_path: Path) -> None:
    order = order_of(tmp_path, preset="row-sum")
    (tmp_path / "work").mkdir()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    died = subprocess.run([sys.executable, "-c", KILLED, json.dumps(order)], env=environment, check=False)
    assert died.returncode == -signal.SIGKILL and not Path(order["output"]).exists()
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "work").rglob("view-*.safetensors")}
    assert len(kept) >= 16
    told = io.BytesIO()
    ended = lift_as_ordered(order, Reporter(told))
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    stages = {json.loads(line).get("stage") for line in told.getvalue().splitlines()}
    assert {"geometry", "solve", "save"} <= stages and ended["count"] == 2000
    whole = lc.lift(lc.read_splats(order["splats"]), lc.read_cameras(order["cameras"]),
                    lc.read_features(*order["features"]), preset="row-sum")  # fmt: skip
    assert torch.equal(lc.load_lift(order["output"]).features, whole.features)


def test_job_that_needs_all_regions_is_lifted_whole_whatever_the_engine(tmp_path: Path) -> None:
    order = order_of(tmp_path, preset="default")
    (tmp_path / "work").mkdir()
    lift_as_ordered(order, Reporter(io.BytesIO()))
    assert lc.load_lift(order["output"]).confidence is not None
