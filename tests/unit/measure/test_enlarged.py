"""Grids of more cells read as the grids that they were made of, but for the rim of a cell."""

from __future__ import annotations

import sys

import pytest
import torch

from liftcore.errors import InvalidFeatures
from liftcore.features.pack import open_packs
from liftcore.features.views import FeatureGrid
from liftcore.features.write_pack import write_pack
from tests.benchmarks import enlarged
from tests.scenes import random_grid, random_regions


def test_a_linear_field_is_the_same_between_the_first_and_the_last_cell_centres():
    y, x = torch.meshgrid(torch.arange(4.0), torch.arange(5.0), indexing="ij")
    larger = enlarged.enlarged(torch.stack([y, x], dim=2), (12, 20))
    assert larger.shape == (12, 20, 2)
    wanted_y, wanted_x = (torch.arange(12) + 0.5) / 3 - 0.5, (torch.arange(20) + 0.5) / 4 - 0.5
    torch.testing.assert_close(larger[:, 0, 0], wanted_y.clamp(0, 3))
    torch.testing.assert_close(larger[0, :, 1], wanted_x.clamp(0, 4))


def test_a_pack_is_enlarged_view_by_view(tmp_path, monkeypatch):
    pack, output = tmp_path / "p.safetensors", tmp_path / "larger.safetensors"
    write_pack(pack, {name: random_grid(seed) for seed, name in enumerate("ab")}, {"encoder": "some"})
    given = ["enlarged", str(pack), "--rows", "9", "--columns", "11", "-o", str(output)]
    monkeypatch.setattr(sys, "argv", given)
    enlarged.main()
    packs = open_packs([output])
    assert (packs.views, packs.encoder) == (("a", "b"), "some")
    for seed, name in enumerate("ab"):
        found = packs.observation(name)
        assert isinstance(found, FeatureGrid)
        assert torch.equal(found.grid, enlarged.enlarged(random_grid(seed).grid, (9, 11)))


def test_regions_are_refused(tmp_path):
    write_pack(tmp_path / "p", {"v": random_regions(1)}, {})
    with pytest.raises(InvalidFeatures, match="regions in v"):
        enlarged.Enlarged(open_packs([tmp_path / "p"]), (3, 3))["v"]
