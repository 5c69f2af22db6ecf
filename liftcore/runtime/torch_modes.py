"""Default modes of torch during a call of the library, as modes that a program sets would change results.

Tensors made in ``torch.inference_mode`` cannot be changed by another thread, ``torch.set_default_device`` applies to
tensors made without a device, and in ``torch.autocast`` matrix products have fewer digits. All three belong to the
thread. The default dtype belongs to the process and is not changed: every tensor of numbers is made with a dtype.
"""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, NamedTuple

import torch

if TYPE_CHECKING:
    from collections.abc import Iterator

CASTING = ("cpu", "cuda")  # devices whose products autocast may change


class _Modes(NamedTuple):
    device: torch.device
    inference: bool
    casts: tuple[torch.dtype | None, ...]  # dtype of autocast on each of CASTING; None: off


_DEFAULT = _Modes(torch.device("cpu"), False, (None,) * len(CASTING))
_callers: ContextVar[_Modes] = ContextVar("callers")


@contextmanager
def default_modes() -> Iterator[None]:
    """Set torch's initial modes: the CPU, neither inference mode nor autocast."""
    token = _callers.set(_modes())
    try:
        with _set(_DEFAULT):
            yield
    finally:
        _callers.reset(token)


@contextmanager
def callers_modes() -> Iterator[None]:
    """Within `default_modes`, restore the caller's modes for the caller's code, such as an iterator that encodes.

    Threads that run such code need the context of the thread that entered (``contextvars.copy_context``).
    """
    with _set(_callers.get(_modes())):
        yield


def _modes() -> _Modes:
    casts = (torch.get_autocast_dtype(name) if torch.is_autocast_enabled(name) else None for name in CASTING)
    return _Modes(torch.get_default_device(), torch.is_inference_mode_enabled(), tuple(casts))


@contextmanager
def _set(modes: _Modes) -> Iterator[None]:
    """Set all modes of the thread; modes that are set already cost nothing."""
    now = _modes()
    with ExitStack() as stack:
        if modes.inference != now.inference:
            stack.enter_context(torch.inference_mode(modes.inference))
        if modes.device != now.device:
            stack.enter_context(modes.device)
        for name, cast, before in zip(CASTING, modes.casts, now.casts, strict=True):
            if cast != before:
                stack.enter_context(torch.autocast(name, cast, enabled=cast is not None))
        yield
