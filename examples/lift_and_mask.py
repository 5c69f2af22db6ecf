# pyright: strict
"""Lift features onto a scene, query a word, and write the masks of all views and the splats with their scores.

python examples/lift_and_mask.py scene.ply sparse/0 features.safetensors "a red mug" out
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import liftcore as lc


def main(splats_path: str, cameras_path: str, features_path: str, word: str, out: str) -> None:
    """Write ``out/masks/VIEW.png`` and ``out/scores.ply``."""
    splats = lc.read_splats(splats_path)
    cameras = lc.read_cameras(cameras_path)
    result = lc.lift(splats, cameras, lc.read_features(features_path), quality="balanced", seed=0)
    answer = result.query(word, splats=splats)
    print(answer.threshold.explanation)

    masks = Path(out, "masks")
    for view, camera in cameras.items():
        share = lc.render(splats, camera, answer.selected, normalise=True)  # of each ray's weight, on selected splats
        picture = np.asarray(share > 0.5, dtype=np.uint8) * 255
        path = masks / f"{view}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture).save(path)
    lc.write_splats(Path(out, "scores.ply"), splats, {"score": answer.scores, "selected": answer.selected})


if __name__ == "__main__":
    main(*sys.argv[1:6])
