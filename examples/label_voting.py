# pyright: strict
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# numpy, scipy and torch leave types of what they compute open
"""Give each splat the class that most of its rays have, with its share and entropy; no encoder is needed.

python examples/label_voting.py scene.ply sparse/0 labels voted.ply

``labels`` is a folder of a PNG a view, named as the view: 8-bit class numbers, 255 for none.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import liftcore as lc

NO_CLASS = 255


def main(splats_path: str, cameras_path: str, labels_path: str, out: str) -> None:
    """Write ``out``, the splats with ``class``, the ``share`` of their rays' weight that has it, and ``entropy``."""
    splats, cameras = lc.read_splats(splats_path), lc.read_cameras(cameras_path)
    maps = {file.stem: np.asarray(Image.open(file)) for file in sorted(Path(labels_path).glob("*.png"))}
    classes = 1 + max(int(labels[labels != NO_CLASS].max(initial=0)) for labels in maps.values())
    codebook = np.eye(classes, dtype=np.float32)  # a region's number is its class
    views = {
        name: lc.Regions(np.where(labels == NO_CLASS, -1, labels).astype(np.int32), codebook)
        for name, labels in maps.items()
    }
    # The weight of each region at each splat; region k of every view is class k, so that votes are sums of columns.
    weights = lc.region_weights(splats, cameras, views, "row-sum").matrix(splats.count)
    votes = weights @ np.tile(np.eye(classes), (len(maps), 1))
    total = votes.sum(axis=1)
    shares = votes / np.maximum(total, 1e-12)[:, None]
    entropy = -(shares * np.log(np.maximum(shares, 1e-12))).sum(axis=1)  # nats; 0 where all rays agree
    columns = {
        "class_id": np.where(total > 0, shares.argmax(axis=1), -1).astype(np.int32),
        "share": shares.max(axis=1).astype(np.float32),
        "entropy": entropy.astype(np.float32),
    }
    lc.write_splats(out, splats, columns)
    count, share = int((total > 0).sum()), float(np.mean(columns["share"]))
    print(f"{count} of {splats.count} splats have a class, with {share:.2f} of their rays' weight on average")


if __name__ == "__main__":
    main(*sys.argv[1:5])
