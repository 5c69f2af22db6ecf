# pyright: strict
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# numpy, scipy and torch leave types of what they compute open
"""Where is it? What a robot asks: a place in front of its camera, a size, and whether it is there at all.

python examples/where_is_it.py scene.lift.safetensors mug --view 0001 [--table words.safetensors]
"""

from argparse import ArgumentParser

import numpy as np

import liftcore as lc


def main() -> None:
    """Print each thing that answers, in the frame of the camera of a view."""
    parser = ArgumentParser(description="Where is it?")
    parser.add_argument("lift")
    parser.add_argument("word")
    parser.add_argument("--view", required=True, help="the camera that asks")
    parser.add_argument("--table", help="vectors of words")
    options = parser.parse_args()
    scene = lc.Scene(options.lift)
    answer = scene.ask(lc.Query(text=[options.word]), encoder=options.table and f"table:{options.table}")
    if answer.present is False or not answer.count:  # None: too few other words to tell
        raise SystemExit(f"{options.word}: not here ({answer.why})")
    camera = scene.camera(options.view)
    world_to_camera = np.asarray(camera.viewmat, dtype=np.float64)
    for found in scene.objects(answer).objects:
        x, y, z = (world_to_camera @ np.array([*found.centre, 1.0]))[:3]
        low, high = np.array(found.box.low), np.array(found.box.high)
        size = " x ".join(f"{length:.2f}" for length in high - low)
        print(f"{options.word}: {x:+.2f} right, {y:+.2f} down, {z:+.2f} ahead; {size}; score {found.score:.2f}")


if __name__ == "__main__":
    main()
