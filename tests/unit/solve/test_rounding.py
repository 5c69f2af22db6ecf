"""Rows of X as they are stored: rounded to float16 as numpy does, whatever the values and wherever they lie."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.raster.cpu.lanes_rows import WIDE
from liftcore.solve.closed_form import finish_rows

CHANNELS = 13  # one whole set of lanes, and a rest


def everything() -> np.ndarray:
    """[n, CHANNELS] f32: noise of all sizes, ties, small values, the ends."""
    rng = np.random.default_rng(0)
    noise = [scale * rng.normal(size=13_000) for scale in (1.0, 1e-3, 1e-5, 1e-7, 1e4)]
    steps = [np.arange(-70_000, 70_000, 3), np.arange(4096) * 2.0**-25, (np.arange(4096) + 0.5) * 2.0**-11]
    ends = [65_504, 65_519.9, 65_520, -65_520, 0.0, -0.0, 2.0**-24, 2.0**-25, -(2.0**-25), 6.1e-5]
    values = np.concatenate([*noise, *steps, ends]).astype(np.float32)
    return np.concatenate([values, np.zeros(-values.size % CHANNELS, np.float32)]).reshape(-1, CHANNELS)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_rows_are_rounded_as_numpy_rounds_them_and_nothing_beside_them_is_touched(dtype: torch.dtype) -> None:
    rows = everything()
    block = np.zeros((len(rows), WIDE), np.float32)
    block[:, :CHANNELS] = rows
    own = slice(3, 3 + len(rows))
    for channels in (7 + CHANNELS, 2 * WIDE):  # the slice is X's last, and it is not
        features, squares = torch.zeros(len(rows) + 5, channels, dtype=dtype), np.zeros(len(rows) + 5)
        kept = features.view(torch.uint16).numpy() if dtype == torch.float16 else features.numpy()
        finish_rows(block, squares[own], 7, kept[own])
        width = min(WIDE, channels - 7)
        with np.errstate(over="ignore"):
            wanted = block[:, :width].astype(features.numpy().dtype)
        assert features.numpy()[own, 7 : 7 + width].tobytes() == wanted.tobytes()
        features[own, 7 : 7 + width] = 0
        assert not features.any()
        np.testing.assert_allclose(squares[own], (rows.astype(np.float64) ** 2).sum(axis=1), rtol=1e-5)
        assert not squares[:3].any() and not squares[own.stop :].any()


def test_norms_alone_keep_no_row() -> None:
    squares = np.zeros(2)
    finish_rows(np.ones((2, WIDE), np.float32), squares, 0, np.empty((0, WIDE), np.float32))
    assert squares.tolist() == [WIDE, WIDE]
