"""Torch's own modes during a call of the library: what a program sets for its models would change what is found.

In ``torch.inference_mode`` tensors that one thread made cannot be changed by another's. ``torch.set_default_dtype``
and ``torch.set_default_device`` are what tensors get that are made without a word of it, and in ``torch.autocast``
products of matrices have fewer digits.
"""

from __future__ import annotations

import threading
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, NamedTuple

import torch

if TYPE_CHECKING:
    from collections.abc import Iterator

CASTING = ("cpu", "cuda")  # devices whose products autocast may change


class _Modes(NamedTuple):
    dtype: torch.dtype
    device: torch.device
    inference: bool
    casts: tuple[torch.dtype | None, ...]  # what autocast makes of products on each of CASTING; None: nothing


class _Calls:
    """The default dtype is the whole process's: the first call in progress keeps it, and the last one restores it."""

    def __init__(self) -> None:
        self._lock, self._running, self._dtype = threading.Lock(), 0, torch.float32

    def begin(self) -> torch.dtype:
        """Take float32; what the callers' default is."""
        with self._lock:
            if not self._running:
                self._dtype = torch.get_default_dtype()
            self._running += 1
            torch.set_default_dtype(torch.float32)
            return self._dtype

    def end(self) -> None:
        """Give the default back, if nobody else is at work."""
        with self._lock:
            self._running -= 1
            if not self._running:
                torch.set_default_dtype(self._dtype)


_calls = _Calls()
_callers: ContextVar[_Modes | None] = ContextVar("callers", default=None)


@contextmanager
def usual_modes() -> Iterator[None]:
    """Torch as it is when a program begins: float32, the CPU, neither inference mode nor autocast."""
    within = _callers.get() is not None  # a call of the caller's code within a call
    dtype = torch.get_default_dtype() if within else _calls.begin()
    token = _callers.set(_modes(dtype))
    torch.set_default_dtype(torch.float32)
    try:
        with _set(_Modes(torch.float32, torch.device("cpu"), False, (None,) * len(CASTING))):
            yield
    finally:
        _callers.reset(token)
        if within:
            torch.set_default_dtype(dtype)
        else:
            _calls.end()


@contextmanager
def callers_modes() -> Iterator[None]:
    """Within `usual_modes`, the modes around it again: for code of the caller, such as an iterator that encodes.

    Threads that run such code need the context of the one that began (``contextvars.copy_context``). While two
    threads lift, code of a caller that relies on another default dtype may meet float32.
    """
    modes = _callers.get()
    if modes is None:
        yield
        return
    torch.set_default_dtype(modes.dtype)
    try:
        with _set(modes):
            yield
    finally:
        torch.set_default_dtype(torch.float32)


def _modes(dtype: torch.dtype) -> _Modes:
    casts = (torch.get_autocast_dtype(name) if torch.is_autocast_enabled(name) else None for name in CASTING)
    return _Modes(dtype, torch.get_default_device(), torch.is_inference_mode_enabled(), tuple(casts))


@contextmanager
def _set(modes: _Modes) -> Iterator[None]:
    """All modes of the thread; what they are already costs nothing."""
    now = _modes(modes.dtype)
    with ExitStack() as stack:
        if modes.inference != now.inference:
            stack.enter_context(torch.inference_mode(modes.inference))
        if modes.device != now.device:
            stack.enter_context(modes.device)
        for name, cast, before in zip(CASTING, modes.casts, now.casts, strict=True):
            if cast != before:
                stack.enter_context(torch.autocast(name, cast, enabled=cast is not None))
        yield
