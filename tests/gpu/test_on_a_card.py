"""Lifts with tensors on a GPU, and uses of their results; on a fake GPU where there is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.evaluate.tradeoff import RunSpec, SceneFiles, measure_run
from liftcore.lifting import in_memory
from liftcore.lifting.in_memory import SceneWeights
from liftcore.solve.consensus import mask_consensus
from liftcore.solve.directions import region_totals
from liftcore.solve.membership import RegionGroups
from liftcore.solve.membership_on_card import memberships_on_card
from liftcore.solve.objects import region_objects
from liftcore.solve.objects_on_card import TreeInputsOnCard
from liftcore.solve.sums import sum_pieces
from liftcore.solve.sums_on_card import region_totals_on_card
from liftcore.values import region_weights as weights
from liftcore.values.region_weights import RegionWeights
from liftcore.values.settings import Preset
from tests import paper_card
from tests.backends import needs_triton
from tests.tiny_scene import WORDS, make_scene
from tests.unit.solve.test_objects_on_card import nested_scene

pytestmark = needs_triton
FEW: dict[str, Any] = {"diagnostic_rays": 6}  # as the interpreter traces one in a thirtieth of a second
GRIDS: list[dict[str, Any]] = [{}, {"preset": "top-k"}, {"cg_steps": 1}, {"aggregation": True}, {"smoothness": 1}]
MAPS: list[dict[str, Any]] = [{"preset": preset.value} for preset in Preset]
MAPS += [{"loss": "huber"}, {"robust_steps": 2}, {"cg_steps": 1}, {"dtype": "float32"}, {"smoothness": 1}]
MAPS += [{"aggregation": True}, {"aggregation": True, "aggregation_resolve": True}, {"objects": True}]
MAPS += [{"smoothness": 1.0}, {"smoothness": "auto"}]
MAPS += [{"aggregation": True, "aggregation_clusters": "graph"}, {"engine": lc.LocalEngine(1)}]
CASES = [*((False, options) for options in MAPS), *((True, options) for options in GRIDS)]


@pytest.fixture(autouse=True)
def card(monkeypatch: pytest.MonkeyPatch) -> None:
    if not torch.cuda.is_available():
        paper_card.lay(monkeypatch)


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    """Splats, cameras, features and a text table of the tiny scene."""
    scene, names = make_scene(), ("splats.ply", "cameras.json", "features.safetensors", "table.safetensors")
    paths = [tmp_path / name for name in names]
    for path, content in zip(paths, (scene.splats, scene.cameras, scene.features, scene.table), strict=True):
        path.write_bytes(content)
    return paths


def lifted(paths: list[Path], views: Any = None, **options: Any) -> lc.LiftResult:
    # Of views in files an engine's plan traces 2,000 rays, which takes the interpreter minutes.
    features = dict(lc.read_features(paths[2])) if "engine" in options else lc.read_features(paths[2])
    views = features if views is None else views
    settings: dict[str, Any] = ({"preset": "row-sum"} if "engine" in options else {}) | FEW | options
    return lc.lift(lc.read_splats(paths[0]), lc.read_cameras(paths[1]), views, **settings)


@pytest.mark.parametrize(
    ("grids", "options"), CASES, ids=[f"{number} {' '.join(options)}" for number, (_, options) in enumerate(CASES)]
)
def test_a_lift_on_a_card_is_the_processors(paths: list[Path], grids: bool, options: dict[str, Any]) -> None:
    views = None
    if grids:
        draw = torch.Generator().manual_seed(0)
        views = {name: lc.FeatureGrid(torch.randn(6, 8, 8, generator=draw)) for name in lc.read_cameras(paths[1])}
    on_cpu, on_gpu = (lifted(paths, views, device=device, **options) for device in ("cpu", "cuda"))
    assert on_gpu.features.is_cuda or "engine" in options, "results stay where the work was; an engine's lie in files"
    on_gpu = on_gpu.cpu()
    for name in ("features", "total_weight", "view_consistency"):
        left, right = getattr(on_cpu, name).float(), getattr(on_gpu, name).float()
        assert torch.allclose(left, right, rtol=2e-3, atol=2e-3), name
    for name in ("object", "node", "node_parents"):
        left, right = getattr(on_cpu, name), getattr(on_gpu, name)
        assert (left is None) == (right is None) and (left is None or torch.equal(left, right)), name
    assert torch.equal(on_cpu.has_feature, on_gpu.has_feature)


@pytest.mark.parametrize("objects", ["auto", True])
def test_a_lift_by_default_leaves_the_weights_on_the_card(paths: list[Path], monkeypatch, objects: Any) -> None:
    copies = list[RegionWeights]()
    monkeypatch.setattr(SceneWeights, "on_processor", property(lambda W: copies.append(W.weights) or W.weights.cpu()))
    result = lifted(paths, objects=objects, device="cuda")
    assert result.metadata.timings["objects"] > 0 and not copies


def test_more_masks_than_a_card_compares_are_compared_here(paths: list[Path], monkeypatch) -> None:
    places, compare = list[bool](), in_memory.mask_consensus

    def compare_here(W: RegionWeights, *arguments: Any, **keywords: Any) -> np.ndarray:
        places.append(W.region.is_cuda)
        return compare(W, *arguments, **keywords)

    on_card = lifted(paths, device="cuda").cpu()
    monkeypatch.setattr(in_memory, "mask_consensus", compare_here)
    monkeypatch.setattr(in_memory, "MOST_MASKS", 8)
    result = lifted(paths, device="cuda").cpu()
    assert places == [False]
    assert torch.allclose(result.features.float(), on_card.features.float(), rtol=2e-3, atol=2e-3)


def test_objects_with_parts_are_the_processors() -> None:
    W, levels = nested_scene(0, 270, equal_weights=False)
    on_card = replace(W, **{name: part.to("cuda") for name, part in W.tensors().items() if name != "offsets"})
    groups, total_weight = RegionGroups.of(W.offsets.numpy(), levels), np.ones(270)
    expected = region_objects(W, levels, total_weight)
    got = region_objects(on_card, levels, total_weight, members=memberships_on_card(on_card, groups))
    assert (expected.tree.parents >= 0).any()
    for name in ("labels", "node", "node_views"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    totals = torch.from_numpy(sum_pieces(region_totals(W), (1, levels.size))[0])
    assert torch.allclose(region_totals_on_card(on_card), totals, rtol=1e-12)


def test_objects_that_no_card_has_memory_for_are_found_here(paths: list[Path], monkeypatch) -> None:
    expected = lifted(paths, objects=True, device="cpu")

    def crowded(*_: Any) -> Any:
        raise torch.OutOfMemoryError

    monkeypatch.setattr(TreeInputsOnCard, "labels", crowded)
    result = lifted(paths, objects=True, device="cuda").cpu()
    assert expected.object is not None and result.object is not None
    assert torch.equal(result.object, expected.object) and result.object.max() == 2


def test_what_follows_a_lift_takes_it_from_the_card(paths: list[Path], tmp_path: Path) -> None:
    result = lifted(paths, objects=True, device="cuda")
    splats, cameras = lc.read_splats(paths[0]), lc.read_cameras(paths[1])
    vectors = torch.from_numpy(lc.open_encoder(f"table:{paths[3]}").encode(list(WORDS)))
    answer = result.query("apple", encoder=f"table:{paths[3]}", splats=splats)
    assert answer.splats.nonzero()[:, 0].tolist() == list(range(20))
    for views in (vectors[0], vectors[0].to("cuda")):
        assert torch.equal(result.query(views).splats, answer.splats)
    assert result.segment(WORDS, vectors, splats).labels.tolist() == [number // 20 for number in range(60)]
    assert len(result.objects(splats, WORDS, vectors.to("cuda")).objects) == 3
    image = lc.render(splats, cameras["middle"], result.features, device="cuda")
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
        assert lc.lift(splats, cameras, {"middle": grid}, "default", device=device, **FEW).has_feature.any()
        ones = lc.render(splats, cameras["middle"], torch.ones(60).to("cuda"), device=device)
        assert torch.equal(ones, lc.render(splats_on_cpu, camera, torch.ones(60), device=device))
        lc.region_weights(splats, cameras, {"middle": regions}, device=device)
        assert lc.plan(splats, {"middle": corner}, {"middle": few}, device=device).views == ("middle",)
    assert lc.plan_photos(splats, cameras).order
    assert result.segment(WORDS, torch.eye(3, 8).to("cuda"), splats).labels.max() >= 0
    answer = result.query(torch.eye(8)[0].to("cuda"), splats=splats)
    assert splats.means[answer.splats].shape[1] == 3


def test_weights_that_no_card_can_stack_are_stacked_here(paths: list[Path], monkeypatch) -> None:
    expected, stack = lifted(paths, device="cuda").cpu(), weights._stacked

    def crowded(parts: Any, *rest: Any) -> Any:
        if parts[0].region.is_cuda:
            raise torch.OutOfMemoryError
        return stack(parts, *rest)

    monkeypatch.setattr(weights, "_stacked", crowded)
    assert torch.allclose(lifted(paths, device="cuda").cpu().features.float(), expected.features.float(), atol=1e-3)


def test_masks_are_compared_on_the_card(paths: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    expected, compare, places = lifted(paths, device="cpu"), in_memory.mask_consensus_on_card, list[str]()

    def crowded(W: Any, *rest: Any, **keywords: Any) -> Any:
        raise torch.OutOfMemoryError

    def compare_there(W: Any, *rest: Any, **keywords: Any) -> Any:
        shares = compare(W, *rest, **keywords)
        places.extend([W.device.type, shares.device.type])
        return shares

    def compare_here(W: Any, *rest: Any, **keywords: Any) -> Any:
        places.append(W.device.type)
        return mask_consensus(W, *rest, **keywords)

    monkeypatch.setattr(in_memory, "mask_consensus", compare_here)
    for work, at in ((compare_there, ["cuda", "cuda"]), (crowded, ["cpu"])):
        places.clear()
        monkeypatch.setattr(in_memory, "mask_consensus_on_card", work)
        features = lifted(paths, device="cuda").cpu().features
        assert places == at
        assert torch.allclose(features.float(), expected.features.float(), atol=1e-3)


def test_a_run_of_a_tradeoff_is_judged_off_the_card(paths: list[Path], tmp_path: Path) -> None:
    scene, devices = SceneFiles(paths[0], paths[1], (paths[2],)), []
    for device in ("cpu", "cuda"):
        settings = FEW | {"preset": "row-sum", "device": device}
        run = RunSpec(scene, settings, ("left", "right"), ("middle",), (), 1, tmp_path, exact=True)
        devices.append(measure_run(run)["accuracies"]["centred_cosine"])
    assert devices[0] == pytest.approx(devices[1], abs=1e-3) and len(devices[0]) == 1
