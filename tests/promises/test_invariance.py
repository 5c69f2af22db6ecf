"""A lift depends on its scene and settings alone: threads, blocks, interruptions and containers change no bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import liftcore as lc
import pytest

from tests.promises.scenes import KERNELS, RandomScene, ShuffledEngine, arrays_of, random_scene, write_pack

SETTINGS: dict[str, dict[str, Any]] = {
    "row-sum": {"preset": "row-sum"},
    "tikhonov": {"preset": "tikhonov", "dtype": "float32"},
    "default": {},
    "top-k": {"preset": "top-k", "top_k": 3, "objects": False},
    "strided": {"stride": 2, "view_stride": 2},
    "fast": {"quality": "fast"},
    "smooth": {"preset": "row-sum", "smoothness": 0.5},
    "clusters": {"preset": "row-sum", "aggregation": True, "aggregation_cluster_size": 5},
    "optimum": {"preset": "row-sum", "reference_channels": 2},
}


class Interruption(Exception):
    """Stands for what ends a lift between two steps."""


def interrupt_at(stage: str) -> Any:
    """Return a progress callback that raises after the first step of a stage."""

    def progress(name: str, completed: int, total: int, unit: str) -> None:
        if name == stage and completed:
            raise Interruption

    return progress


def lift(scene: RandomScene, progress: Any = False, **keywords: Any) -> dict[str, tuple[Any, ...]]:
    options = {"diagnostic_rays": 0, **keywords}  # they change no array, and take most of the time of a small lift
    return arrays_of(lc.lift(*scene.arguments(), progress=progress, **options))


@pytest.fixture(scope="module")
def regions() -> RandomScene:
    return random_scene(wrong=0.2)


@pytest.fixture(scope="module")
def grids() -> RandomScene:
    return random_scene(grids=True)


@pytest.mark.parametrize(
    ("name", "kind"), [*((name, "regions") for name in SETTINGS), ("default", "grids"), ("smooth", "grids")]
)
def test_threads_engines_and_resumption_change_no_bit(
    name: str, kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    scene, settings = request.getfixturevalue(kind), SETTINGS[name]
    expected = lift(scene, threads=1, **settings)
    assert lift(scene, threads=3, **settings) == expected
    assert lift(scene, engine=ShuffledEngine(2), **settings) == expected
    for stage in ("geometry", "solve"):
        with pytest.raises(Interruption):
            lift(scene, interrupt_at(stage), checkpoint=tmp_path, **settings)
    assert any(tmp_path.iterdir())
    assert lift(scene, threads=2, checkpoint=tmp_path, **settings) == expected


@pytest.mark.parametrize("kernel", KERNELS[1:])
def test_threads_and_engines_change_no_bit_of_any_kernel(kernel: str) -> None:
    scene = random_scene(5, kernel=kernel)
    expected = lift(scene, threads=1)
    assert lift(scene, threads=3) == expected
    assert lift(scene, engine=lc.open_engine("local", threads=1)) == expected


@pytest.mark.parametrize("kind", ["regions", "grids"])
def test_container_of_the_views_changes_no_bit(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    scene = request.getfixturevalue(kind)
    expected = lift(scene)
    reversed_views = dict(reversed(scene.views.items()))
    for views in (
        reversed_views,
        iter(reversed_views.items()),
        lc.read_features(write_pack(tmp_path / "pack.safetensors", scene.views)),
        lc.read_features(
            write_pack(tmp_path / "a.safetensors", {"v0": scene.views["v0"]}),
            write_pack(tmp_path / "b.safetensors", {k: scene.views[k] for k in ("v3", "v2", "v1")}),
        ),
    ):
        assert lift(replace(scene, views=views)) == expected
    assert lift(replace(scene, cameras=dict(reversed(list(scene.cameras.items()))))) == expected


def test_files_give_the_bits_of_their_values(regions: RandomScene, tmp_path: Path) -> None:
    result = lc.lift(*regions.arguments(), progress=False)
    assert arrays_of(result) == lift(regions)  # which has no diagnostics
    pack = write_pack(tmp_path / "pack.safetensors", regions.views)
    path = result.save_scene(tmp_path, regions.splats, regions.cameras)
    of_files = lc.lift_files(tmp_path / "splats.ply", tmp_path / "cameras.json", [pack], progress=False)
    assert arrays_of(lc.load_lift(path)) == arrays_of(of_files) == arrays_of(result)
    assert (of_files.views, of_files.settings) == (result.views, result.settings)


def test_several_blocks_of_splats_and_views_change_no_bit() -> None:
    """More splats and views than an engine takes at once, resumed on another engine."""
    scene = random_scene(7, count=140_000, views=10)
    splats = scene.splats
    tiny = lc.Splats(splats.means, splats.quats, splats.log_scales - 3, splats.opacity_logits)
    scene = replace(scene, splats=tiny)
    assert lift(scene, engine=ShuffledEngine(2)) == lift(scene)


@pytest.mark.parametrize("engine", [None, lc.LocalEngine(1)], ids=["memory", "files"])
def test_checkpoint_serves_the_same_geometry_and_features_alone(
    engine: lc.LocalEngine | None, regions: RandomScene, tmp_path: Path
) -> None:
    """A folder of another lift's weights never changes a result, whatever differs between the two."""
    moved_splats = replace(regions, splats=replace(regions.splats, means=regions.splats.means + 1e-3))
    relabelled = dict(regions.views)
    first = regions.views["v0"]
    assert isinstance(first, lc.Regions)
    relabelled["v0"] = lc.Regions(first.labels.flip(2), first.codebook)
    other_features = {
        name: lc.Regions(view.labels, view.codebook.flip(0))
        for name, view in regions.views.items()
        if isinstance(view, lc.Regions)
    }
    for scene, settings in (
        (moved_splats, {}),
        (replace(regions, views=relabelled), {}),
        (replace(regions, views=other_features), {}),
        (regions, {"preset": "tikhonov"}),
        (regions, {"alpha_cap": 0.5}),
        (regions, {"stride": 2}),
    ):
        lift(regions, checkpoint=tmp_path, preset="row-sum", engine=engine)
        assert any(tmp_path.iterdir())
        options = {"preset": "row-sum", **settings}
        assert lift(scene, checkpoint=tmp_path, engine=engine, **options) == lift(scene, **options)


@pytest.mark.parametrize("damage", ["cut", "noise"])
def test_damaged_checkpoint_is_computed_again(damage: str, regions: RandomScene, tmp_path: Path) -> None:
    expected = lift(regions, checkpoint=str(tmp_path))
    answers = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(answers) >= 4
    (tmp_path / "thesis.tex").write_text("words")
    for path in answers:
        content = path.read_bytes()
        path.write_bytes({"cut": content[: len(content) // 2], "noise": b"words"}[damage])
    assert lift(regions, checkpoint=tmp_path) == expected
    assert (tmp_path / "thesis.tex").read_text() == "words"
