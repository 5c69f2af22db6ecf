"""Colours that are made: OKLab to sRGB, and the lobes of DBS."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from liftcore.query.colours import _lobes, _srgb

# sRGB primaries, greys and a dark grey, in OKLab as other programs round them.
KNOWN = [
    ((1.0, 0.0, 0.0), (255, 255, 255)),
    ((0.62796, 0.22486, 0.12585), (255, 0, 0)),
    ((0.86644, -0.23389, 0.17950), (0, 255, 0)),
    ((0.45201, -0.03246, -0.31153), (0, 0, 255)),
    ((0.96798, -0.07137, 0.19857), (255, 255, 0)),
    ((0.59987, 0.0, 0.0), (128, 128, 128)),
    ((0.08452, 0.0, 0.0), (2, 2, 2)),  # where sRGB is linear
]


@pytest.mark.parametrize(("oklab", "srgb"), KNOWN)
def test_oklab_becomes_the_srgb_that_it_stands_for(oklab: tuple[float, ...], srgb: tuple[int, ...]) -> None:
    found = _srgb(*(np.array(part) for part in oklab))
    assert np.abs(found.astype(int) - srgb).max() <= 1


def test_a_lobe_seen_from_behind_gives_nothing_at_any_exponent() -> None:
    along_z = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    for b in (-60.0, 0.0, 60.0):
        lobe = torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0, b]).expand(2, 1, 6)
        seen, behind = _lobes(along_z, lobe)
        assert math.isclose(float(seen[0]), 1.0, abs_tol=1e-3) and not behind.any()
