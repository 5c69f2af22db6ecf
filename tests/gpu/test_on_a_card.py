"""Lifts with tensors on a GPU, and uses of their results; on a fake GPU where there is none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from tests import paper_card
from tests.backends import needs_triton
from tests.promises.tiny_files import write_files
from tests.tiny_scene import WORDS

pytestmark = needs_triton
FEW: dict[str, Any] = {"diagnostic_rays": 6}  # as the interpreter traces one in a thirtieth of a second
CASES: list[tuple[bool, dict[str, Any]]] = [
    (False, {"preset": "argmax"}),
    (False, {"aggregation": True, "objects": True}),
    (True, {}),  # maps of features in place of masks
]


@pytest.fixture(autouse=True)
def card(monkeypatch: pytest.MonkeyPatch) -> None:
    if not torch.cuda.is_available():
        paper_card.lay(monkeypatch)


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    """Splats, cameras, features and a text table of the tiny scene."""
    return list(write_files(tmp_path).values())


def lifted(paths: list[Path], views: Any = None, **options: Any) -> lc.LiftResult:
    views = lc.read_features(paths[2]) if views is None else views
    return lc.lift(lc.read_splats(paths[0]), lc.read_cameras(paths[1]), views, **FEW, **options)


@pytest.mark.parametrize(
    ("grids", "options"), CASES, ids=[f"{number} {' '.join(options)}" for number, (_, options) in enumerate(CASES)]
)
def test_a_lift_on_a_card_is_the_processors(paths: list[Path], grids: bool, options: dict[str, Any]) -> None:
    views = None
    if grids:
        draw = torch.Generator().manual_seed(0)
        views = {name: lc.FeatureGrid(torch.randn(6, 8, 8, generator=draw)) for name in lc.read_cameras(paths[1])}
    on_cpu, on_gpu = (lifted(paths, views, device=device, **options) for device in ("cpu", "cuda"))
    assert on_gpu.features.is_cuda, "results stay where the work was"
    on_gpu = on_gpu.cpu()
    for name in ("features", "total_weight"):
        left, right = getattr(on_cpu, name).float(), getattr(on_gpu, name).float()
        assert torch.allclose(left, right, rtol=2e-3, atol=2e-3), name
    for name in ("object", "node", "node_parents"):
        left, right = getattr(on_cpu, name), getattr(on_gpu, name)
        assert (left is None) == (right is None) and (left is None or torch.equal(left, right)), name
    assert torch.equal(on_cpu.has_feature, on_gpu.has_feature)


def test_what_follows_a_lift_takes_it_from_the_card(paths: list[Path], tmp_path: Path) -> None:
    result = lifted(paths, objects=True, device="cuda")
    splats, cameras = lc.read_splats(paths[0]), lc.read_cameras(paths[1])
    vectors = torch.from_numpy(lc.open_encoder(f"table:{paths[3]}").encode(list(WORDS)))
    answer = result.query("apple", encoder=f"table:{paths[3]}", splats=splats)
    assert np.flatnonzero(answer.selected).tolist() == list(range(20))
    for views in (vectors[0], vectors[0].to("cuda")):
        assert np.array_equal(result.query(views).selected, answer.selected)
    assert result.scene(splats).segment(WORDS, vectors).rows.tolist() == [number // 20 for number in range(60)]
    assert len(result.scene(splats).tree(WORDS, vectors.to("cuda")).objects) == 3
    image = lc.render(splats, cameras["middle"], result.features)
    assert image.shape == (24, 32, 8)
    lc.region_weights(splats, cameras, lc.read_features(paths[2]), device="cuda").matrix(splats.count)
    result.save(tmp_path / "made.safetensors")
    assert torch.equal(lc.load_lift(tmp_path / "made.safetensors").features, result.cpu().features)


def test_tensors_of_a_card_come_in(paths: list[Path]) -> None:
    """As a training loop has them: splats, cameras, maps and values."""
    splats_on_cpu, views, camera = (
        lc.read_splats(paths[0]),
        lc.read_features(paths[2]),
        lc.read_cameras(paths[1])["middle"],
    )
    means, quats, scales, logits = (
        part.to("cuda")
        for part in (splats_on_cpu.means, splats_on_cpu.quats, splats_on_cpu.log_scales, splats_on_cpu.opacity_logits)
    )
    splats = lc.Splats(means, quats, scales, logits)
    pose, K = (torch.tensor(matrix).to("cuda") for matrix in (camera.viewmat, camera.K))
    cameras = {"middle": lc.Camera(pose, K, camera.width, camera.height)}
    map_ = views["middle"]
    assert isinstance(map_, lc.Regions)
    regions = lc.Regions(map_.labels.to("cuda"), map_.codebook.to("cuda"))
    grid = lc.FeatureGrid(torch.ones(6, 8, 8).to("cuda"))
    # A plan traces all rays of so small a view, which takes the interpreter a minute.
    corner, few = lc.Camera(pose, K, 6, 4), lc.Regions(regions.labels[:4, :6], regions.codebook)
    for device in ("cpu", "cuda"):
        expected = lc.lift(splats_on_cpu, cameras, {"middle": views["middle"]}, device=device, **FEW).cpu()
        result = lc.lift(splats, cameras, {"middle": regions}, device=device, **FEW)
        assert torch.equal(result.cpu().features, expected.features)
        assert lc.lift(splats, cameras, iter([("middle", grid)]), device=device, **FEW).has_feature.any()
        lc.region_weights(splats, cameras, {"middle": regions}, device=device)
        assert lc.plan(splats, {"middle": corner}, {"middle": few}, device=device).views == ("middle",)
    ones = lc.render(splats, cameras["middle"], torch.ones(60).to("cuda"))
    assert torch.equal(ones, lc.render(splats_on_cpu, camera, torch.ones(60)))
    assert result.scene(splats).segment(WORDS, torch.eye(3, 8).to("cuda")).rows.max() >= 0
    answer = result.query(torch.eye(8)[0].to("cuda"), splats=splats)
    assert splats.means[answer.selected].shape[1] == 3
