"""``splatlift inspect``: describe a file and its problems."""

from __future__ import annotations

import argparse
from pathlib import Path

from liftcore.cli.options import Parser
from liftcore.cli.reply import reply

CAMERAS = """\
how cameras are read
- Of several COLMAP models (sparse/0, sparse/1, ...) the one with cameras for
  most views of the features is read, or else the largest, and a warning lists
  the others. Choose one if there are a distorted and an undistorted model.
- If transforms.json has no w and h, the size of each photo is read from the
  photo at file_path, with or without a suffix. In a folder without
  transforms.json, transforms_train.json is read, and a warning lists the views
  of test and val.
- ns-export cameras writes only poses, in the frame of the exported splats. Put
  the transforms.json of the data next to its list, for the intrinsics by the
  photo's name.
- A camera with an invalid pose is skipped, with a warning.
- Lenses: COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, OPENCV_FISHEYE,
  SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, SIMPLE_FISHEYE and FISHEYE, and
  nerfstudio's k1 to k4, p1, p2. Others are errors.
"""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.appendix = lambda: CAMERAS
    parser.add_argument("file", type=Path, help="splats, cameras, features, a lift, masks or a text table")


def run(options: argparse.Namespace) -> int:
    """Describe a file of any kind."""
    from liftcore.evaluate import inspect_file

    document = {"file": str(options.file), **inspect_file(options.file)}
    unnamed = {name: "not named" for name in ("encoder", "text_space") if document.get(name) == ""}
    reply(document if options.json else document | unnamed, as_json=options.json)
    return 0
