"""What the plan says of channels and memory."""

from __future__ import annotations

import numpy as np
import pytest

from liftcore.errors import InvalidSettings, Unavailable
from liftcore.observe.pack import open_packs
from liftcore.plan.memory import check_memory, free_memory
from liftcore.plan.rank import ROUNDING, codebook_rank, rank_of
from liftcore.solve.settings import LiftSettings, Speed
from tests.unit.solve.test_lift_equals_dense import write_scene

GIB = 1 << 30


@pytest.mark.parametrize("dtype", ["float16", "float32"])
@pytest.mark.parametrize("rank", [1, 7, 40])
@pytest.mark.parametrize("shape", [(300, 64), (50, 96)])
def test_rank_is_that_of_the_vectors_before_they_were_rounded(dtype, rank, shape):
    rng = np.random.default_rng(rank)
    rows = rng.normal(size=(shape[0], rank)) @ rng.normal(size=(rank, shape[1]))
    found = rank_of(rows.astype(dtype).astype(np.float64), ROUNDING["F16" if dtype == "float16" else "F32"])
    assert (found.rank, found.rows, found.channels) == (rank, *shape)
    assert 1 <= found.enough <= rank


def test_nothing_has_no_rank():
    assert rank_of(np.zeros((4, 3)), ROUNDING["F32"]).rank == 0


@pytest.mark.parametrize("grids", [False, True])
def test_rank_of_packs_looks_at_all_their_views(tmp_path, grids):
    packs = open_packs([write_scene(tmp_path, 2, grids)[2]])
    found = codebook_rank(packs, packs.views)
    assert (found.channels, found.rank) == (6, 6)
    assert found.rows >= 6


def test_what_cannot_fit_is_refused_and_what_may_not_is_told():
    parts = {"features": 6 * GIB, "codebooks": GIB, "weights": GIB}
    assert check_memory(parts, 20 * GIB) == []
    assert "8.0 GiB" in check_memory(parts, 8 * GIB)[0]
    with pytest.raises(Unavailable, match=r"7\.0 GiB for features"):
        check_memory(parts, 6 * GIB)
    assert check_memory(parts, None) == []
    assert (free_memory() or GIB) > 0


def test_the_dial_sets_what_is_not_set_beside_it():
    fast, drafted = LiftSettings.of(speed="fast"), LiftSettings.of(speed="draft", stride=2, preset="row-sum")
    assert LiftSettings.of(speed="exact").model_dump() == LiftSettings.of().model_dump()
    assert (fast.stride > 1, fast.certificate_rays < 10_000, fast.power) == (True, True, 2)
    assert (drafted.stride, drafted.power, drafted.transmittance_stop > 1e-4) == (2, 1, True)
    strides = [LiftSettings.of(speed=speed).stride for speed in Speed]
    assert strides == sorted(strides)
    with pytest.raises(InvalidSettings, match="speed"):
        LiftSettings.of(speed="ludicrous")
