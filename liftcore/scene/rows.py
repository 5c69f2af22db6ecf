"""Rows of a table over splats: those that a mask, a slice or numbers choose."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.errors import InvalidInput

if TYPE_CHECKING:
    from torch import Tensor

Rows = Any  # a boolean mask [P], a slice, or whole numbers [n]; of numpy, torch on any device, or a list


def chosen_rows(keep: Rows, count: int) -> Tensor:
    """The numbers [n] i64, on the CPU, of the rows that are kept, in the order in which they are named.

    Args:
        keep: booleans [P], a slice, or whole numbers [n], of which negative ones count from the end. count: P.

    Raises:
        InvalidInput: a mask of another length, a number out of range, something else than these, or no row at all.
    """
    expected = f"booleans [{count}], a slice, or row numbers in 0..{count - 1}"
    if isinstance(keep, slice):
        try:
            rows = torch.arange(count)[_forward(keep, count)]
        except TypeError:
            raise InvalidInput("keep", expected=expected, got=repr(keep)[:80]) from None
    else:
        given = _as_tensor(keep, expected)
        if given.dtype == torch.bool:
            if len(given) != count:
                got, hint = f"a mask of {len(given)}", "a mask has an entry for each row"
                raise InvalidInput("keep", expected=expected, got=got, hint=hint)
            rows = torch.nonzero(given)[:, 0]
        else:
            rows = given.to(torch.int64)
            wrong = rows[(rows < -count) | (rows >= count)]
            if len(wrong):
                raise InvalidInput("keep", expected=expected, got=f"row {int(wrong[0])} of {count}")
            rows = torch.where(rows < 0, rows + count, rows)
    if not len(rows):
        raise InvalidInput("keep", expected="at least one row", got=f"none of {count}")
    return rows


def _as_tensor(keep: Any, expected: str) -> Tensor:
    if isinstance(keep, torch.Tensor):
        given = keep.detach().cpu()
    else:
        try:
            given = torch.from_numpy(np.array(keep))
        except (TypeError, ValueError):
            got = f"{type(keep).__name__} {keep!r}"[:80]
            raise InvalidInput("keep", expected=expected, got=got) from None
    if given.ndim == 2 and given.shape[1] == 1:
        given = given[:, 0]
    if given.shape == (0,) and given.dtype != torch.bool:  # an empty list, which has no type
        return given.to(torch.int64)
    if given.ndim != 1 or given.is_floating_point() or given.is_complex():
        kind = str(given.dtype).removeprefix("torch.")
        got = f"{kind} {list(given.shape)}" if given.ndim else f"{keep!r}"[:80]
        hint = "a single row is keep=[row]" if not given.ndim else ""
        raise InvalidInput("keep", expected=expected, got=got, hint=hint)
    return given


def _forward(keep: slice, count: int) -> Tensor:
    """The rows of a slice, whose step may be negative, which torch does not take."""
    return torch.tensor(range(*keep.indices(count)), dtype=torch.int64)
