"""Subsets of splats, and splats and cameras transformed to another frame."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import liftcore as lc
from liftcore.query.splat_colours import view_colours
from liftcore.scene.kernel import Kernel
from tests.scenes import random_camera, random_splats

TURN = Rotation.from_rotvec([0.4, -1.1, 0.7])
MATRIX = np.block([[2.5 * TURN.as_matrix(), np.array([[3.0], [-1.0], [7.0]])], [np.array([[0.0, 0.0, 0.0, 1.0]])]])


def coloured(kernel: Kernel) -> lc.Splats:
    splats = random_splats(5, 60, kernel=kernel)
    rng = np.random.default_rng(1)
    sh = torch.tensor(rng.normal(size=(60, 16, 3)), dtype=torch.float32)
    lobes = torch.tensor(rng.normal(size=(60, 2, 6)), dtype=torch.float32) if kernel is Kernel.BETA else None
    extras = {name: torch.tensor(rng.normal(size=60)) for name in ("nx", "ny", "nz")} | {"mask": torch.arange(60)}
    return replace(splats, sh=sh, sb_params=lobes, extras=extras)


@pytest.mark.parametrize("keep", [np.arange(60) % 3 == 1, list(range(1, 60, 3)), torch.arange(-59, 0, 3)])
def test_chosen_rows_have_all_their_columns(keep: Any) -> None:
    splats = coloured(Kernel.BETA)
    subset = splats[keep]
    assert len(subset) == subset.count == 20
    for name in ("means", "quats", "log_scales", "opacity_logits", "beta", "sh", "sb_params"):
        assert torch.equal(getattr(subset, name), getattr(splats, name)[1::3]), name
    assert subset.extras["mask"].tolist() == list(range(1, 60, 3)) and subset.kernel is splats.kernel


def test_rows_may_come_in_another_order_and_keep_an_origin_of_map_coordinates() -> None:
    splats = random_splats(1)
    far = replace(splats, means=splats.means.double() + torch.tensor([5e5, 5.4e6, 300.0]).double(), origin=None)
    reverse = far[::-1]
    assert reverse.origin == far.origin != (0, 0, 0)
    np.testing.assert_array_equal(reverse.positions(), far.positions()[::-1])
    transformed = far.transformed(MATRIX)
    np.testing.assert_allclose(
        transformed.positions(), far.positions() @ MATRIX[:3, :3].T + MATRIX[:3, 3], rtol=0, atol=1e-4
    )


@pytest.mark.parametrize(
    ("keep", "message"),
    [
        (np.ones(59, bool), r"keep: expected booleans \[60\], .* 59; a mask has an entry for each row"),
        (np.zeros(60, bool), "keep: expected at least one row, got none of 60"),
        ([0, 60], "keep: .* index 60 is out of bounds"),
        (7, r"keep: .*, got 7; .* a single row is keep=\[row\]"),
    ],
)
def test_what_chooses_no_rows_is_refused(keep: Any, message: str) -> None:
    with pytest.raises(lc.InvalidInput, match=message):
        coloured(Kernel.GAUSSIAN_3D)[keep]


@pytest.mark.parametrize("kernel", list(Kernel))
def test_cameras_moved_with_the_splats_see_the_same(kernel: Kernel) -> None:
    splats, camera = coloured(kernel), random_camera(3)
    values = np.random.default_rng(2).random((60, 2))
    transformed, seen_from = splats.transformed(torch.from_numpy(MATRIX)), camera.transformed(MATRIX)
    np.testing.assert_allclose(
        transformed.positions(), splats.positions() @ MATRIX[:3, :3].T + MATRIX[:3, 3], atol=1e-4
    )
    image, other = lc.render(splats, camera, values), lc.render(transformed, seen_from, values)
    assert float(image.max()) > 0.1 and float((image - other).abs().max()) < 2e-3
    colours, other_colours = view_colours(splats, camera), view_colours(transformed, seen_from)
    assert torch.allclose(colours, other_colours, atol=2e-3) and float(colours.std()) > 0.1
    normals = [
        torch.stack([item.extras[name] for name in ("nx", "ny", "nz")], dim=1) for item in (splats, transformed)
    ]
    np.testing.assert_allclose(TURN.apply(normals[0].numpy()), normals[1].numpy(), atol=1e-12)
    assert lc.Cameras([camera]).transformed(MATRIX)["v0"].centre.tolist() == pytest.approx(seen_from.centre.tolist())


def test_zero_quaternions_turn_as_identities() -> None:
    splats = replace(random_splats(0, 2), quats=torch.tensor([[0.0, 0, 0, 0], [1.0, 0, 0, 0]]))
    quats = splats.transformed(MATRIX).quats
    assert torch.equal(quats[0], quats[1]) and abs(abs(float(quats[0, 0])) - abs(TURN.as_quat()[3])) < 1e-6


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([1.0, 1, -1, 1]), "a rotation times a scale, no reflection"),
        (np.diag([1.0, 2, 3, 1]), "a proper rotation"),
        (np.eye(3), r"finite numbers \[4, 4\] or \[3, 4\], got shape \[3, 3\]"),
        (MATRIX.T, "0 0 0 1 as the last row"),
    ],
)
def test_what_is_no_similarity_is_refused(matrix: Any, message: str) -> None:
    for value in (random_splats(0), random_camera(0)):
        with pytest.raises(lc.InvalidInput, match=f"matrix: expected {message}"):
            value.transformed(matrix)
