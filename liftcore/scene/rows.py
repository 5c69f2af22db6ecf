"""Rows of a table over splats, selected by a mask, a slice or numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.errors import InvalidInput

if TYPE_CHECKING:
    from torch import Tensor

Rows = Any  # a boolean mask [P], a slice, or whole numbers [n]; of numpy, torch on any device, or a list


def chosen_rows(keep: Rows, count: int) -> Tensor:
    """Return the numbers [n] i64, on the CPU, of the selected rows, in the order of the selection.

    Args:
        keep: booleans [P], a slice, or whole numbers [n], of which negative ones count from the end. count: P.
    """
    expected = f"booleans [{count}], a slice, or row numbers in 0..{count - 1}"
    if isinstance(keep, slice):
        try:
            rows = torch.arange(count)[_forward(keep, count)]
        except TypeError:
            raise InvalidInput("keep", expected=expected, got=repr(keep)[:80]) from None
    else:
        selection = _as_tensor(keep, expected)
        if selection.dtype == torch.bool:
            if len(selection) != count:
                got, hint = f"a mask of {len(selection)}", "a mask has an entry for each row"
                raise InvalidInput("keep", expected=expected, got=got, hint=hint)
            rows = torch.nonzero(selection)[:, 0]
        else:
            rows = selection.to(torch.int64)
            wrong = rows[(rows < -count) | (rows >= count)]
            if len(wrong):
                raise InvalidInput("keep", expected=expected, got=f"row {int(wrong[0])} of {count}")
            rows = torch.where(rows < 0, rows + count, rows)
    if not len(rows):
        raise InvalidInput("keep", expected="at least one row", got=f"none of {count}")
    return rows


def _as_tensor(keep: Any, expected: str) -> Tensor:
    if isinstance(keep, torch.Tensor):
        selection = keep.detach().cpu()
    else:
        try:
            selection = torch.from_numpy(np.array(keep))
        except (TypeError, ValueError):
            got = f"{type(keep).__name__} {keep!r}"[:80]
            raise InvalidInput("keep", expected=expected, got=got) from None
    if selection.ndim == 2 and selection.shape[1] == 1:
        selection = selection[:, 0]
    if selection.shape == (0,) and selection.dtype != torch.bool:  # an empty list, which has no type
        return selection.to(torch.int64)
    if selection.ndim != 1 or selection.is_floating_point() or selection.is_complex():
        kind = str(selection.dtype).removeprefix("torch.")
        got = f"{kind} {list(selection.shape)}" if selection.ndim else f"{keep!r}"[:80]
        hint = "a single row is keep=[row]" if not selection.ndim else ""
        raise InvalidInput("keep", expected=expected, got=got, hint=hint)
    return selection


def _forward(keep: slice, count: int) -> Tensor:
    """Return the rows of a slice, whose step may be negative, which torch does not take."""
    return torch.tensor(range(*keep.indices(count)), dtype=torch.int64)
