"""Torch's own modes during a call of the library: what a program sets for its models would change what is found.

In ``torch.inference_mode`` tensors that one thread made cannot be changed by another's. ``torch.set_default_dtype``
and ``torch.set_default_device`` are what tensors get that are made without a word of it.
"""

from __future__ import annotations

import threading
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, NamedTuple

import torch

if TYPE_CHECKING:
    from collections.abc import Iterator

_of_thread = threading.local()


class _Modes(NamedTuple):
    dtype: torch.dtype
    device: torch.device
    inference: bool


_USUAL = _Modes(torch.float32, torch.device("cpu"), False)


@contextmanager
def usual_modes() -> Iterator[None]:
    """Torch as it is when a program begins.

    The default dtype is the whole process's: a second thread that sets another one meanwhile has to wait.
    """
    callers = _modes()
    if callers == _USUAL:
        yield
        return
    before = getattr(_of_thread, "callers", None)
    _of_thread.callers = callers
    try:
        with _set(_USUAL):
            yield
    finally:
        _of_thread.callers = before


@contextmanager
def callers_modes() -> Iterator[None]:
    """Within `usual_modes`, the modes around it again: for code of the caller, such as an iterator that encodes."""
    callers = getattr(_of_thread, "callers", None)
    with nullcontext() if callers is None else _set(callers):
        yield


def _modes() -> _Modes:
    return _Modes(torch.get_default_dtype(), torch.get_default_device(), torch.is_inference_mode_enabled())


@contextmanager
def _set(modes: _Modes) -> Iterator[None]:
    before = _modes()
    torch.set_default_dtype(modes.dtype)
    try:
        with torch.inference_mode(modes.inference), modes.device if modes.device != before.device else nullcontext():
            yield
    finally:
        torch.set_default_dtype(before.dtype)
