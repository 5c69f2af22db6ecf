"""Declarations of two operators that torchvision's Python code needs where its compiled library did not load.

The PyPI build of torchvision is linked against the CUDA build of torch. With the CPU build of torch its compiled
library does not load, and its import fails with ``operator torchvision::nms does not exist`` while it registers shape
functions. open_clip and sentence-transformers import torchvision, but a text tower never calls these operators. With
their signatures declared, the import succeeds, and a call of them would still fail.
"""

import importlib

import torch

# Operators exist as long as the library object that declared them.
_libraries: list[torch.library.Library] = []


def import_torchvision() -> None:
    """Import torchvision, declaring the missing operators only if the import fails without them.

    A compiled library that loads declares the operators itself, and a second declaration would be an error, so the
    import is tried first.
    """
    try:
        importlib.import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::" not in str(error) or _libraries:
            raise
        library = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            if not hasattr(torch.ops.torchvision, name):
                library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        _libraries.append(library)
        importlib.import_module("torchvision")
