"""Names of torch devices as values of settings. Imports no torch."""

from __future__ import annotations

import re
import sys

from liftcore.errors import InvalidSettings

_DEVICE_NUMBER = re.compile(r"cuda:([0-9]{1,4})")


def device_name(device: object) -> object:
    """Return ``cuda`` for the current GPU, given as ``cuda:0`` or a ``torch.device``; other values unchanged."""
    name = str(device) if type(device).__module__ == "torch" else device
    match = _DEVICE_NUMBER.fullmatch(name) if isinstance(name, str) else None
    if match is None:
        return name
    torch, number = sys.modules.get("torch"), int(match[1])
    current = torch.cuda.current_device() if torch is not None and torch.cuda.is_available() else 0
    if number != current:
        hint = f"set CUDA_VISIBLE_DEVICES={number}, or call torch.cuda.set_device({number}), and use device=cuda"
        raise InvalidSettings("device", expected=f"cuda:{current}, the current GPU", got=repr(str(name)), hint=hint)
    return "cuda"
