# pyright: strict
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# numpy, scipy and torch leave types of what they compute open
"""Locate an object for a robot: its position relative to a camera, its size, or that it is not in the scene.

python examples/where_is_it.py scene.lift.safetensors mug --view 0001 [--table words.safetensors]
"""

from argparse import ArgumentParser

import numpy as np

import liftcore as lc


def main() -> None:
    """Print each object that matches the word, in the frame of the camera of a view."""
    parser = ArgumentParser(description="Locate an object relative to a camera.")
    parser.add_argument("lift")
    parser.add_argument("word")
    parser.add_argument("--view", required=True, help="the view whose camera is the origin")
    parser.add_argument("--table", help="vectors of words")
    options = parser.parse_args()
    scene = lc.Scene(options.lift)
    answer = scene.ask(lc.Query(text=[options.word]), encoder=options.table and f"table:{options.table}")
    if answer.present is False or not answer.count:  # None: unknown, as there are too few other words
        raise SystemExit(f"{options.word}: not here ({answer.reason})")
    camera = scene.camera(options.view)
    world_to_camera = np.asarray(camera.viewmat, dtype=np.float64)
    for item in scene.objects(answer).objects:
        x, y, z = (world_to_camera @ np.array([*item.centre, 1.0]))[:3]
        low, high = np.array(item.box.low), np.array(item.box.high)
        size = " x ".join(f"{length:.2f}" for length in high - low)
        print(f"{options.word}: {x:+.2f} right, {y:+.2f} down, {z:+.2f} ahead; {size}; score {item.score:.2f}")


if __name__ == "__main__":
    main()
