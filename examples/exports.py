# pyright: strict
"""Export the objects of a lift for other programs, each named by the nearest word.

python examples/exports.py scene.lift.safetensors words.safetensors out

``.glb`` opens in viewers of glTF, ``.ply`` in editors of splats. ``.json`` has COCO's masks in the views. The PLY is
read again at the end.
"""

import sys
from pathlib import Path

import numpy as np

import liftcore as lc

SUFFIXES = (".glb", ".ply", ".json")


def main(lift: str, table: str, out: str) -> None:
    """Write ``out/things`` with each of the suffixes."""
    scene, encoder = lc.Scene(lift), f"table:{table}"
    objects = scene.tree(scene.words(encoder), encoder=encoder)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    for suffix in SUFFIXES:
        path = folder / f"things{suffix}"
        scene.export(path, objects)
        print(f"{path.name}: {path.stat().st_size} bytes")
    names = [item.name or f"object {item.id}" for item in objects.objects]
    numbers = np.asarray(lc.read_splats(folder / "things.ply").extras["instance_id"])
    for number, name in enumerate(names, start=1):  # 0 is none
        print(f"{name}: {int((numbers == number).sum())} splats")


if __name__ == "__main__":
    main(*sys.argv[1:4])
