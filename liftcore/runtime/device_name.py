"""Names of devices as torch has them, in the words of the settings. Loads no torch."""

from __future__ import annotations

import re
import sys

from liftcore.errors import InvalidSettings

_NUMBERED = re.compile(r"cuda:([0-9]{1,4})")


def device_name(device: object) -> object:
    """``cuda`` for the card that is current here, as ``cuda:0`` or a ``torch.device``; anything else as it is.

    Raises:
        InvalidSettings: another card, which calls of this process do not run on.
    """
    name = str(device) if type(device).__module__ == "torch" else device
    numbered = _NUMBERED.fullmatch(name) if isinstance(name, str) else None
    if numbered is None:
        return name
    torch, number = sys.modules.get("torch"), int(numbered[1])
    current = torch.cuda.current_device() if torch is not None and torch.cuda.is_available() else 0
    if number != current:
        hint = f"set CUDA_VISIBLE_DEVICES={number}, or torch.cuda.set_device({number}), and take device=cuda"
        raise InvalidSettings(
            "device", expected=f"cuda:{current}, the card that is current", got=repr(str(name)), hint=hint
        )
    return "cuda"
