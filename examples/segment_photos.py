# pyright: strict
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingImports=false
# segment-anything is no dependency of splatlift
"""Write SAM's masks of each photo as JSON, for ``splatlift pack masks --encoder``.

python examples/segment_photos.py photos masks

This needs segment-anything and the weights ``sam_vit_h_4b8939.pth`` in the working directory.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from segment_anything import SamAutomaticMaskGenerator, build_sam_vit_h


def main(photos: str, masks: str) -> None:
    """Write ``masks/VIEW.json`` for each ``photos/VIEW.jpg``."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    sam = build_sam_vit_h(checkpoint="sam_vit_h_4b8939.pth").to(device)
    generator = SamAutomaticMaskGenerator(sam, output_mode="uncompressed_rle")
    Path(masks).mkdir(exist_ok=True)
    for photo in sorted(Path(photos).glob("*.jpg")):
        if records := generator.generate(np.asarray(Image.open(photo).convert("RGB"))):
            Path(masks, f"{photo.stem}.json").write_text(json.dumps(records), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:3])
