"""Default modes of torch during a call of the library, as modes that a program sets would change results.

Tensors made in ``torch.inference_mode`` cannot be changed by another thread, ``torch.set_default_device`` applies to
tensors made without a device, and in ``torch.autocast`` matrix products have fewer digits. All three belong to the
thread. The default dtype belongs to the process and is not changed: every tensor of numbers is made with a dtype.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any

import torch


def _autocast(device: str, dtype: torch.dtype | None) -> torch.autocast:
    return torch.autocast(device, dtype, enabled=dtype is not None)


CASTING = ("cpu", "cuda")  # devices whose products autocast may change
_SETTERS: Any = (torch.inference_mode, torch.device, *(partial(_autocast, name) for name in CASTING))
_DEFAULT = (False, torch.device("cpu"), None, None)  # of each setter
_callers: ContextVar[tuple[Any, ...]] = ContextVar("callers")


@contextmanager
def default_modes() -> Iterator[None]:
    """Set torch's initial modes: the CPU, neither inference mode nor autocast."""
    token = _callers.set(_modes())
    try:
        with _set(_DEFAULT):
            yield
    finally:
        _callers.reset(token)


def callers_modes() -> ExitStack:
    """Within `default_modes`, restore the caller's modes for the caller's code, such as an iterator that encodes.

    Threads that run such code need the context of the thread that entered (``contextvars.copy_context``).
    """
    return _set(_callers.get(_modes()))


def _modes() -> tuple[Any, ...]:
    """Return the thread's modes, one of each setter; of autocast the dtype, None where it is off."""
    casts = (torch.get_autocast_dtype(name) if torch.is_autocast_enabled(name) else None for name in CASTING)
    return (torch.is_inference_mode_enabled(), torch.get_default_device(), *casts)


def _set(modes: tuple[Any, ...]) -> ExitStack:
    """Set all modes of the thread; modes that are set already cost nothing."""
    with ExitStack() as stack:
        for setter, mode, before in zip(_SETTERS, modes, _modes(), strict=True):
            if mode != before:
                stack.enter_context(setter(mode))
        return stack.pop_all()
