"""Declares two operators that torchvision's Python half expects, where its compiled half did not load.

The PyPI build of torchvision is linked against the CUDA build of torch. Beside the CPU build of torch its
compiled library does not load, and its import then fails on ``operator torchvision::nms does not exist``
while it registers shape functions. open_clip and sentence-transformers import torchvision, yet a text tower
never calls these operators: declaring their signatures lets the import pass, and a call would still fail.
"""

import importlib

import torch

# A library's operators live as long as the object that declared them.
_declared: list[torch.library.Library] = []


def import_torchvision() -> None:
    """Import torchvision, declaring the missing operators only where the plain import fails for their lack.

    Where the compiled half loads, it declares the operators itself and a second declaration would be an
    error: so the plain import is tried first.
    """
    try:
        importlib.import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::" not in str(error) or _declared:
            raise
        library = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            if not hasattr(torch.ops.torchvision, name):
                library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        _declared.append(library)
        importlib.import_module("torchvision")
