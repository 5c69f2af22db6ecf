"""Torch's own modes during a call of the library: what a program sets for its models would change what is found.

In ``torch.inference_mode`` tensors that one thread made cannot be changed by another's, ``torch.set_default_device``
is what tensors get that are made without a word of it, and in ``torch.autocast`` products of matrices have fewer
digits. All three are the thread's own. The default dtype is the whole process's, so it is left alone: every tensor of
numbers is made with its dtype.
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
    casts: tuple[torch.dtype | None, ...]  # what autocast makes of products on each of CASTING; None: nothing


_USUAL = _Modes(torch.device("cpu"), False, (None,) * len(CASTING))
_callers: ContextVar[_Modes] = ContextVar("callers")


@contextmanager
def usual_modes() -> Iterator[None]:
    """Torch as it is when a program begins: the CPU, neither inference mode nor autocast."""
    token = _callers.set(_modes())
    try:
        with _set(_USUAL):
            yield
    finally:
        _callers.reset(token)


@contextmanager
def callers_modes() -> Iterator[None]:
    """Within `usual_modes`, the modes around it again: for code of the caller, such as an iterator that encodes.

    Threads that run such code need the context of the one that began (``contextvars.copy_context``).
    """
    with _set(_callers.get(_modes())):
        yield


def _modes() -> _Modes:
    casts = (torch.get_autocast_dtype(name) if torch.is_autocast_enabled(name) else None for name in CASTING)
    return _Modes(torch.get_default_device(), torch.is_inference_mode_enabled(), tuple(casts))


@contextmanager
def _set(modes: _Modes) -> Iterator[None]:
    """All modes of the thread; what they are already costs nothing."""
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
