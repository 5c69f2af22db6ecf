"""``splatlift inspect``: what is in this file, and what is wrong with it."""

from __future__ import annotations

import argparse

from liftcore.cli.options import Parser, place
from liftcore.cli.reply import reply

CAMERAS = """\
how cameras are read
- Of several COLMAP models (sparse/0, sparse/1, ...) the one with cameras for
  most views of the features is read, else the largest, and a warning names the
  others. Between a distorted and an undistorted model you must choose.
- A transforms.json without w and h takes each photo's size from the photo at
  file_path, with or without a suffix. Of a folder transforms_train.json is read
  if there is no transforms.json, and a warning names the views of test and val.
- ns-export cameras writes poses alone, in the frame of the exported splats. Put
  the transforms.json of the data beside its list, for the intrinsics by the
  photo's name.
- A camera with a broken pose is skipped, with a warning.
- Lenses: COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, OPENCV_FISHEYE,
  SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, SIMPLE_FISHEYE and FISHEYE, and
  nerfstudio's k1 to k4, p1, p2. Others are refused.
- A panorama P (EQUIRECTANGULAR of both) becomes six cameras, the faces of a
  cube: P@front, P@right, P@back, P@left, P@up and P@down. All six read the
  features of the photo P.
"""


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    parser.appendix = lambda: CAMERAS
    parser.add_argument("file", type=place, help="splats, cameras, features, a lift, masks or a text table")


def run(options: argparse.Namespace) -> int:
    """Describe a file of any kind."""
    from liftcore.evaluate import inspect_file

    document = {"file": str(options.file), **inspect_file(options.file)}
    unnamed = {name: "not named" for name in ("encoder", "text_space") if document.get(name) == ""}
    reply(document if options.json else document | unnamed, as_json=options.json)
    return 0
