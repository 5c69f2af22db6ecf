"""Transfer of a lift to other splats of its scene: equal rows, mixtures, and an aligned scene after a motion."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidSplats
from liftcore.query.result import LiftResult
from liftcore.query.scene import Scene
from liftcore.scene.quaternions import rotation_matrices
from liftcore.scene.splats import Splats

TURN = rotation_matrices(np.array((0.8, 0.2, -0.4, 0.3)))
MATRIX = np.column_stack([2.5 * TURN, (10.0, -4.0, 7.0)])


@pytest.fixture
def lifted(scene: Scene) -> tuple[LiftResult, Splats]:
    """The tiny scene's lift and splats, with distinct colours."""
    sh = torch.from_numpy(np.random.default_rng(5).uniform(-1.5, 1.5, (scene.splats.count, 1, 3)).astype("f4"))
    splats = Splats(
        **{name: getattr(scene.splats, name) for name in ("means", "quats", "log_scales", "opacity_logits")}, sh=sh
    )
    return LiftResult.of(scene.lift), splats


def test_a_moved_scene_needs_the_matrix_of_its_motion(lifted: tuple[LiftResult, Splats]) -> None:
    result, splats = lifted
    order = np.random.default_rng(2).permutation(splats.count)
    transformed = splats[order].transformed(MATRIX)
    other = result.transferred(splats, transformed, matrix=MATRIX[:3])
    assert torch.equal(other.features, result.features[order]) and not other.metadata.cameras.path
    with pytest.raises(InvalidSplats, match="give the matrix"):
        result.transferred(splats, transformed)


def test_new_splats_of_elsewhere_have_no_feature_and_move_no_scene(lifted: tuple[LiftResult, Splats]) -> None:
    result, splats = lifted
    places = splats.means.clone()
    places[::4] += 20  # a quarter of the copy is of elsewhere
    copy = Splats(places, splats.quats, splats.log_scales, splats.opacity_logits, sh=splats.sh)
    moved_lift = result.transferred(splats, copy)
    assert moved_lift.diagnostics["transfer"]["without_partner"] == 15
    assert torch.equal(moved_lift.features[1::4], result.features[1::4])
    assert not moved_lift.has_feature[::4].any() and not moved_lift.features[::4].any()
    assert moved_lift.object is not None and (moved_lift.object[::4] == -1).all()
