# pyright: strict
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingImports=false
# gsplat's examples are no dependency of splatlift
"""Write the transform of gsplat's trainer beside the camera files, where splatlift reads it.

python gsplat_transform.py data/garden 4

Run it in gsplat's ``examples`` folder, with the scene and the ``data_factor`` of the training.
"""

import json
import sys
from pathlib import Path

from datasets.colmap import Parser


def main(scene: str, factor: str = "4") -> None:
    """Write ``scene/dataparser_transforms.json``."""
    transform = Parser(scene, factor=int(factor), normalize=True).transform[:3]
    document = {"transform": transform.tolist(), "scale": 1.0}
    Path(scene, "dataparser_transforms.json").write_text(json.dumps(document), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:3])
