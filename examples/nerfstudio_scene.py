# pyright: strict
"""Lift onto splats that nerfstudio trained: its export, the data's cameras, and the frame of its training.

python examples/nerfstudio_scene.py splat.ply data outputs/plants/splatfacto/RUN features.safetensors out

``splat.ply`` is of ``ns-export gaussian-splat``, ``data`` has ``transforms.json``, and the run's folder
``dataparser_transforms.json``: nerfstudio turns, centres and scales cameras before it trains.
"""

import shutil
import sys
from pathlib import Path

import liftcore as lc

FRAME = "dataparser_transforms.json"


def main(splats_path: str, data: str, run: str, features_path: str, out: str) -> None:
    """Write ``out/lift.safetensors``, and beside it the cameras in the frame of the splats."""
    splats, folder = lc.read_splats(splats_path), Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    for file in (Path(data, "transforms.json"), Path(run, FRAME)):  # cameras and frame in one folder belong together
        shutil.copy(file, folder / file.name)
    cameras = lc.read_cameras(folder)
    plan = lc.plan(splats, cameras, lc.read_features(features_path))
    for warning in plan.warnings:  # where few cameras see the splats, the frame is another run's
        print("warning:", warning)
    result = lc.lift(splats, cameras, lc.read_features(features_path))
    result.save(folder / "lift.safetensors")
    count = int(result.has_feature.sum())
    print(f"{len(cameras)} cameras moved to the frame of the splats; {count} of {splats.count} splats have a feature")


if __name__ == "__main__":
    main(*sys.argv[1:6])
