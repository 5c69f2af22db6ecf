# pyright: strict
"""Make a folder to share: the lift with its splats and cameras, which opens wherever the folder is moved.

python examples/share_folder.py scene.ply sparse/0 features.safetensors shared

Others run ``splatlift view shared/lift.safetensors``, or open it in Python as at the end.
"""

import sys
from pathlib import Path

import liftcore as lc


def main(splats_path: str, cameras_path: str, features_path: str, out: str) -> None:
    """Write ``out`` with three files, and open it again."""
    splats, cameras = lc.read_splats(splats_path), lc.read_cameras(cameras_path)
    result = lc.lift(splats, cameras, lc.read_features(features_path))
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    lift = result.save_scene(folder, splats, cameras)
    for file in sorted(folder.iterdir()):
        print(f"{file.name}: {file.stat().st_size} bytes")

    scene = lc.Scene(lift)
    objects = scene.tree()
    print(objects.explanation)


if __name__ == "__main__":
    main(*sys.argv[1:5])
