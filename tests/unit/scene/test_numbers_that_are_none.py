"""NaN and infinity in trained splats: their colours are grey, and warnings count them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from liftcore.io.splats import read_places, read_splats
from liftcore.query.splat_colours import view_colours
from liftcore.scene.kernel import Kernel
from tests.scenes import look_at, random_splats
from tests.tiny_scene import PROPERTIES, ply, splat_rows

COUNT = 40


@pytest.mark.parametrize("kernel", [Kernel.GAUSSIAN_3D, Kernel.BETA])
def test_a_colour_that_is_no_number_is_grey_from_everywhere(kernel: Kernel) -> None:
    splats = random_splats(3, COUNT, kernel=kernel)
    sh = torch.rand(COUNT, 4, 3)
    sh[7, 2, 1], sh[8, 0, 0] = np.nan, np.inf
    lobes = torch.rand(COUNT, 2, 6) if kernel is Kernel.BETA else None
    if lobes is not None:
        lobes[9, 1, 3] = np.nan
    with_colours = replace(splats, sh=sh, sb_params=lobes)
    grey = [7, 8] + [9] * (lobes is not None)
    assert f"{len(grey)} of 40 splats have a colour that is no number" in with_colours.warnings[0]
    for centre in ([3.0, 1.0, -4.0], [0.0, -5.0, 0.3]):
        colours = view_colours(with_colours, look_at("v", np.array(centre), 8, 8, 8.0))
        torch.testing.assert_close(colours[grey], torch.full((len(grey), 3), 0.5), atol=1e-6, rtol=0)
        assert bool(torch.isfinite(colours).all())
    assert torch.equal(with_colours.opacity_logits, splats.opacity_logits)


def test_places_of_no_number_are_those_that_the_splats_get(tmp_path: Path) -> None:
    rows = splat_rows()
    rows[4, PROPERTIES.index("x")] = np.nan
    (tmp_path / "s.ply").write_bytes(ply(rows))
    assert np.array_equal(read_places(tmp_path / "s.ply"), read_splats(tmp_path / "s.ply").means.numpy())
