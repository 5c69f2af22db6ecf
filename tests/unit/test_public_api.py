"""``import liftcore as lc``: its list, what it loads, lifts of values in memory, and what a lift tells meanwhile."""

import ast
import json
import logging
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore import models
from liftcore.lifting.files import lift_files
from tests.docs.readme import site_text
from tests.scenes import observed, random_splats, write_scene

ROOT = Path(__file__).parents[2]
MOST_NAMES = 60  # of `import liftcore`
MOST_OF_ALL = 117  # with those of the public modules: each more must be worth its place
MODULES = ("cli", "errors", "evaluate", "files", "models", "testing", "text", "text.table")
USERS = [path for room in ("liftcore/cli", "service") for path in sorted((ROOT / room).rglob("*.py"))]


@pytest.fixture
def scene(tmp_path):
    """The paths of a scene of three views, and its values."""
    paths = write_scene(tmp_path, 3)
    return paths, lc.read_splats(paths[0]), lc.read_cameras(paths[1]), {f"v{k}": observed(3, k) for k in range(3)}


def as_numpy(view):
    if isinstance(view, lc.Regions):
        return lc.Regions(view.labels.numpy(), view.codebook.numpy())
    return lc.FeatureGrid(view.grid.numpy())


def public_names() -> dict[str, list[str]]:
    """Module -> its public names."""
    return {name: import_module(name).__all__ for name in ("liftcore", *(f"liftcore.{one}" for one in MODULES))}


def test_public_names_are_few_load_and_are_in_the_documents():
    found, page = public_names(), site_text("docs/python.md")
    assert len(found["liftcore"]) <= MOST_NAMES and len({*chain(*found.values())}) <= MOST_OF_ALL
    for module, names in found.items():
        assert len(names) == len(set(names))
        assert all(getattr(import_module(module), name) is not None for name in names)
        assert module == "liftcore" or (import_module(module).__doc__ or "").startswith("Public: ")
        assert not [name for name in names if not re.search(rf"\b{name}\b", page)]


def imported_names(path):
    """The names that a file imports of liftcore, each with its module, wherever in the file."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "liftcore":
            found += [(node.module, name.name) for name in node.names]
        if isinstance(node, ast.Import):
            found += [(name.name, "") for name in node.names if name.name.startswith("liftcore.")]
    return found


@pytest.mark.parametrize("path", USERS, ids=lambda path: str(path.relative_to(ROOT)))
def test_command_line_and_service_import_public_names_alone(path):
    """What a command or a route needs, a user's program can have: a public name, or a new one for both."""
    public = public_names()
    public["liftcore"] = [*public["liftcore"], "__version__", *MODULES]
    own = path.is_relative_to(ROOT / "liftcore")  # files of the command line import each other
    private = [
        (module, name)
        for module, name in imported_names(path)
        if name not in public.get(module, ()) and not (own and module.startswith("liftcore.cli"))
    ]
    assert not private


def test_import_loads_neither_torch_nor_numba():
    code = (
        "import sys, json, liftcore; print(json.dumps([m for m in ('torch', 'numba', 'numpy') if m in sys.modules]))"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert json.loads(told) == []


@pytest.mark.parametrize("given", ["dict", "numpy", "iterator", "pack"])
def test_lift_of_values_has_the_bits_of_the_lift_of_files(scene, given):
    (splats, cameras, pack), cloud, poses, views = scene
    forms = {
        "dict": lambda: views,
        "numpy": lambda: {name: as_numpy(view) for name, view in views.items()},
        "iterator": lambda: iter(views.items()),
        "pack": lambda: lc.read_features(pack),
    }
    expected = lift_files(splats, cameras, [pack], lc.LiftSettings.of(preset="row-sum"))
    found = lc.lift(cloud, poses, forms[given](), preset="row-sum")
    for name in ("features", "total_weight", "agreement", "seen"):
        assert torch.equal(getattr(found, name), getattr(expected, name))
    assert found.views == expected.views == ("v0", "v1", "v2")
    assert found.diagnostics["residual"] == pytest.approx(expected.diagnostics["residual"], rel=0.5)


def test_iterator_is_taken_one_view_at_a_time_and_once(scene):
    _, splats, cameras, views = scene
    taken = []

    def each():
        for name, view in views.items():
            taken.append(name)
            yield name, view
        yield "nobody", views["v0"]

    found = lc.lift(splats, cameras, each())
    assert taken == list(views)
    assert found.diagnostics["views_without_camera"] == ["nobody"]


def test_saved_result_opens_as_it_was(scene, tmp_path):
    _, splats, cameras, views = scene
    made = lc.lift(splats, cameras, views, robust_steps=1)
    made.save(tmp_path / "made.safetensors")
    back = lc.load_lift(tmp_path / "made.safetensors")
    assert torch.equal(made.features, back.features) and back.settings == made.settings
    assert made.settings.robust_steps == 1


def test_plan_chooses_what_the_lift_takes(scene):
    _, splats, cameras, views = scene
    plan = lc.plan(splats, cameras, views, coverage=1)
    made = lc.lift(splats, cameras, views, coverage=1)
    assert made.views == plan.views and len(plan.views) + len(plan.left_out) == 3
    strided = lc.plan(splats, cameras, views, view_stride=2)
    assert any("; 2 of 3 views" in line for line in strided.lines())


def test_view_of_another_kind_is_refused_by_name(scene):
    _, splats, cameras, _ = scene
    with pytest.raises(lc.InvalidFeatures, match="Regions or FeatureGrid") as told:
        lc.lift(splats, cameras, {"v0": torch.ones(2, 2, 4)})  # pyright: ignore[reportArgumentType]
    assert "v0" in told.value.argument


def test_render_composites_numbers_of_splats(scene):
    _, splats, cameras, _ = scene
    camera = cameras["v0"]
    ones = lc.render(splats, camera, np.ones(splats.count))
    both = lc.render(splats, camera, torch.ones(splats.count, 2) * torch.tensor([1.0, 3.0]))
    assert ones.shape == (camera.height, camera.width) and both.shape == (camera.height, camera.width, 2)
    assert torch.allclose(both[:, :, 1], 3 * ones, atol=1e-6)
    share = lc.render(splats, camera, torch.ones(splats.count), normalise=True)
    assert torch.allclose(share[ones > 0], torch.ones(()), atol=1e-6)
    with pytest.raises(lc.InvalidSettings, match="a row a splat"):
        lc.render(splats, camera, torch.ones(splats.count + 1))


def test_render_of_cameras_is_an_image_of_each_by_its_name(scene):
    _, splats, cameras, _ = scene
    chosen = splats.means[:, 0] > 0
    images = lc.render(splats, cameras, chosen, normalise=True)
    assert list(images) == list(cameras)
    for name, camera in cameras.items():
        assert torch.equal(images[name], lc.render(splats, camera, chosen, normalise=True))
        assert images[name].shape == (camera.height, camera.width) and bool((images[name] > 0.5).any())
    with pytest.raises(lc.InvalidCameras, match="camera: expected a Camera, got 3"):
        lc.render(splats, {"v0": cameras["v0"], "v1": 3}, chosen)  # pyright: ignore


def test_region_weights_times_codebooks_are_the_lift(scene):
    _, splats, cameras, views = scene
    found = lc.region_weights(splats, cameras, views, preset="row-sum")
    W = found.matrix(splats.count)
    E = np.concatenate([views[name].codebook.double().numpy() for name in found.views])
    assert W.shape == (splats.count, len(E)) and found.offsets.tolist()[0] == 0
    made = lc.lift(splats, cameras, views, preset="row-sum", dtype="float32")
    sums = W.sum(axis=1)
    assert ((sums > 0) == made.seen.numpy()).all()
    X = np.divide(W @ E, sums[:, None], out=np.zeros((splats.count, E.shape[1])), where=sums[:, None] > 0)
    np.testing.assert_allclose(made.features.numpy(), X, atol=1e-5)
    again = lc.region_weights(splats, cameras, iter(views.items()), preset="row-sum", threads=2)
    assert torch.equal(again.weight, found.weight) and torch.equal(again.region, found.region)


@pytest.mark.parametrize("settings", [{}, {"preset": "row-sum", "loss": "huber"}])
def test_reweighted_region_weights_times_codebooks_are_the_lift_of_any_preset(scene, settings):
    _, splats, cameras, views = scene
    found = lc.region_weights(splats, cameras, views, reweight=True, **settings)
    plain = lc.region_weights(splats, cameras, views, **settings)
    W = found.matrix(splats.count)
    E = np.concatenate([views[name].codebook.double().numpy() for name in found.views])
    made = lc.lift(splats, cameras, views, dtype="float32", **settings)
    seen = made.seen.numpy()
    np.testing.assert_allclose(made.features.numpy()[seen], (W @ E)[seen] / W.sum(axis=1)[seen, None], atol=1e-5)
    assert torch.equal(found.region, plain.region) and not torch.equal(found.weight, plain.weight)


def test_every_stage_is_told_in_order_and_the_plan_after_the_first_views(tmp_path):
    splats, cameras, pack = write_scene(tmp_path, 3)
    said = []
    plans = []

    def hear(stage, done, total, unit):
        said.append((stage, done, total, unit))

    def on_plan(plan):
        plans.append((plan, {stage: done for stage, done, *_ in said}))

    made = lift_files(splats, cameras, [pack], lc.LiftSettings.of(), progress=hear, on_plan=on_plan)
    [(plan, before)] = plans
    assert before == {"read": 1, "digest": 1, "compile": 1, "plan": 1, "geometry": 3}
    assert plan.facts() == made.metadata.diagnostics["plan"]
    for stage in ("read", "digest", "compile", "plan", "certify"):
        assert [word for word in said if word[0] == stage] == [(stage, 0, 1, "steps"), (stage, 1, 1, "steps")]
    order = list(dict.fromkeys(stage for stage, *_ in said))
    assert order == ["read", "digest", "compile", "plan", "geometry", "robust", "solve", "certify"]
    assert set(order) <= made.metadata.timings.keys()
    for stage in order:
        done = [word[1] for word in said if word[0] == stage]
        assert done == sorted(done)


def test_what_a_machine_lacks_goes_to_whoever_listens_else_to_the_log(tmp_path, monkeypatch, caplog):
    little_memory = "the rest of the lift may take 9.0 GiB and 1.0 GiB are free"
    monkeypatch.setattr("liftcore.lifting.planning.plan.check_memory", lambda parts, free: [little_memory])
    splats, cameras, pack = write_scene(tmp_path, 3)
    heard = []

    def refuse(plan):
        raise InterruptedError(plan.kernel)

    with pytest.raises(InterruptedError, match="3dgs"):  # a hearer that refuses stops the lift
        lift_files(splats, cameras, [pack], lc.LiftSettings.of(), on_plan=refuse)
    with caplog.at_level(logging.WARNING):
        lift_files(splats, cameras, [pack], lc.LiftSettings.of(), on_plan=heard.append)
        assert heard[0].warnings == (little_memory,) and little_memory not in caplog.text
        lift_files(splats, cameras, [pack], lc.LiftSettings.of())
        assert caplog.text.count(little_memory) == 1


@pytest.mark.parametrize(
    ("changed", "error", "told"),
    [
        ({"splats": "scene.ply"}, lc.InvalidSplats, r"splats: .*got str 'scene.ply'; .*read_splats"),
        ({"cameras": "sparse/0"}, lc.InvalidCameras, r"cameras: .*got str 'sparse/0'; read_cameras"),
        ({"cameras": {0: None}}, lc.InvalidCameras, r"cameras: expected names that are texts, as of photos, got 0"),
        ({"cameras": None}, lc.InvalidCameras, r"cameras: expected a Camera for each name, got NoneType"),
        ({"views": "pack.safetensors"}, lc.InvalidFeatures, r"features: .*got str 'pack.safetensors'; read_features"),
        ({"views": None}, lc.InvalidFeatures, r"features: expected views by name"),
        ({"views": [torch.ones(2, 2, 4)]}, lc.InvalidFeatures, r"features: expected pairs of a name and a view"),
        ({"threads": 0}, lc.InvalidSettings, r"threads: expected a whole number of one or more, .*got 0"),
        ({"threads": 1.5}, lc.InvalidSettings, r"threads: .*got 1.5"),
        ({"threads": True}, lc.InvalidSettings, r"threads: .*got True"),
        (
            {"views": {0: None}},
            lc.InvalidFeatures,
            r"features: expected names that are texts, as of cameras, got int 0",
        ),
        ({"views": [(0, None)]}, lc.InvalidFeatures, r"features: expected names that are texts"),
        ({"device": "tpu"}, lc.InvalidSettings, r"device: expected 'auto', 'cpu' or 'cuda', got 'tpu'"),
        ({"robust_step": 1}, lc.InvalidSettings, r"robust_step: .*nearest: robust_steps"),
    ],
)
@pytest.mark.parametrize("call", [lc.lift, lc.plan, lc.region_weights])
def test_what_is_no_such_value_is_refused_by_its_name(scene, call, changed, error, told):
    _, splats, cameras, views = scene
    given = {"splats": splats, "cameras": cameras, "views": views} | changed
    with pytest.raises(error, match=told):
        call(**given)


def test_settings_and_keywords_beside_them_are_one(scene):
    _, splats, cameras, views = scene
    settings = lc.LiftSettings.of(preset="row-sum", stride=2)
    whole = lc.region_weights(splats, cameras, views, preset="row-sum")
    strided = lc.region_weights(splats, cameras, views, settings, view_stride=2)
    assert lc.lift(splats, cameras, views, settings, view_stride=2).settings.stride == 2
    assert lc.plan(splats, cameras, views, settings, view_stride=2).views == strided.views == ("v0", "v2")
    assert float(whole.weight.sum()) > 2 * float(strided.weight.sum())
    chosen = lc.lift(splats, cameras, views, lc.LiftSettings.of(speed="fast", seed=3), speed="exact").settings
    assert chosen == lc.LiftSettings.of(speed="exact", seed=3, antialiased=False)  # which auto came to
    assert lc.lift(splats, cameras, views, lc.LiftSettings.of(), robust_steps=0).confidence is None


def test_answers_refuse_splats_of_another_scene(scene):
    _, splats, cameras, views = scene
    made = lc.lift(splats, cameras, views, preset="row-sum")
    vectors = torch.eye(2, made.features.shape[1])
    names = ("means", "quats", "log_scales", "opacity_logits")
    fewer = lc.Splats(**{name: getattr(splats, name)[1:] for name in names})
    others: list[Any] = [fewer, "scene.ply"]
    for other in others:
        for ask in (
            lambda other=other: made.query(vectors, splats=other),
            lambda other=other: made.segment(["a", "b"], vectors, other),
            lambda other=other: made.objects(other),
        ):
            with pytest.raises(lc.InvalidSplats, match=f"the {splats.count} Splats that were lifted"):
                ask()


def test_what_is_no_engine_and_too_few_rows_are_refused(scene):
    _, splats, cameras, views = scene
    with pytest.raises(lc.InvalidSettings, match=r"engine: expected an engine, or None, got 'local'; LocalEngine"):
        lc.lift(splats, cameras, views, engine="local")  # pyright: ignore[reportArgumentType]
    strange: list[Any] = [5, ""]
    for checkpoint in strange:
        with pytest.raises(lc.InvalidSettings, match="checkpoint: expected the path of a folder"):
            lc.lift(splats, cameras, views, checkpoint=checkpoint)
    with pytest.raises(lc.InvalidInput, match="splats: expected"):
        lc.region_weights(splats, cameras, views).matrix(1)


def test_render_refuses_the_name_of_a_camera_and_an_unknown_device(scene):
    _, splats, cameras, _ = scene
    with pytest.raises(lc.InvalidSettings, match="device: expected 'auto', 'cpu' or 'cuda', got 'tpu'"):
        lc.render(splats, cameras["v0"], torch.ones(splats.count), device="tpu")
    for values in (None, "colours", [["x"]]):
        with pytest.raises(lc.InvalidSettings, match="values: expected"):
            lc.render(splats, cameras["v0"], values)  # pyright: ignore[reportCallIssue, reportArgumentType]
    with pytest.raises(lc.InvalidSettings, match="params: expected CompositingParams"):
        lc.render(splats, cameras["v0"], np.ones(splats.count), {})  # pyright: ignore[reportCallIssue, reportArgumentType]
    swapped = np.arange(splats.count)[::-1].astype(">i4")
    assert lc.render(splats, cameras["v0"], swapped).shape == (cameras["v0"].height, cameras["v0"].width)
    with pytest.raises(lc.InvalidCameras, match=r"camera: expected a Camera, got 'v0'; cameras\[name\]"):
        lc.render(splats, "v0", torch.ones(splats.count))  # pyright: ignore[reportCallIssue, reportArgumentType]


def test_render_refuses_to_drop_a_gradient_that_is_recorded(scene):
    _, splats, cameras, _ = scene
    values = torch.ones(splats.count, 2, requires_grad=True)
    with pytest.raises(lc.InvalidSettings, match=r"values: .*gradient.*values\.detach\(\)"):
        lc.render(splats, cameras["v0"], values)
    plain = lc.render(splats, cameras["v0"], values.detach())
    for mode in (torch.no_grad(), torch.inference_mode()):
        with mode:
            assert torch.equal(lc.render(splats, cameras["v0"], values), plain)


@pytest.mark.skipif(torch.cuda.is_available(), reason="with a GPU these calls run on it")
def test_the_current_card_may_be_named_by_its_number(scene):
    _, splats, cameras, views = scene
    for device in ("cuda:0", torch.device("cuda:0"), torch.device("cuda")):
        with pytest.raises(lc.Unavailable, match="device"):
            lc.render(splats, cameras["v0"], torch.ones(splats.count), device=device)
        with pytest.raises(lc.Unavailable, match="device"):
            lc.lift(splats, cameras, views, device=device)
    for call in (lc.lift, lc.plan):
        with pytest.raises(lc.InvalidSettings, match=r"cuda:0, .*got 'cuda:3'.*CUDA_VISIBLE"):
            call(splats, cameras, views, device="cuda:3")


def test_splats_of_activated_opacities_and_scales_are_told_in_the_plan(scene):
    _, _, cameras, views = scene
    splats = random_splats(3, 200, spread=1.5)
    opacities, scales = torch.sigmoid(splats.opacity_logits), splats.log_scales.exp()
    plan = lc.plan(replace(splats, opacity_logits=opacities, log_scales=scales), cameras, views)
    warnings = plan.input_warnings
    assert any("no logits" in text for text in warnings) and any("no logarithms" in text for text in warnings)
    for old, new in (("told", "input_warnings"), ("there", "available_views"), ("kept_on_card", "gpu_weight_bytes")):
        with pytest.deprecated_call(match=f"{old} is now {new}"):
            assert getattr(plan, old) == getattr(plan, new)
    assert plan.available_views == len(views)
    assert not any("as if they were no" in text for text in lc.plan(splats, cameras, views).input_warnings)


def test_region_weights_of_a_label_a_pixel_are_the_weights_of_rays(scene):
    _, splats, cameras, _ = scene
    camera = cameras["v0"]
    labels = np.arange(camera.height * camera.width).reshape(1, camera.height, camera.width)
    W = lc.region_weights(splats, {"v0": camera}, {"v0": lc.Regions(labels, np.ones((labels.size, 1), np.float32))})
    values = np.random.default_rng(0).normal(size=splats.count)
    image = lc.render(splats, camera, values).numpy().ravel()
    np.testing.assert_allclose(W.matrix(splats.count).T @ values, image, atol=1e-4)


@pytest.mark.parametrize("engine", [None, lc.LocalEngine(1)])
def test_checkpoint_is_a_folder_by_its_path_or_its_text(scene, engine, tmp_path):
    _, splats, cameras, views = scene
    made = [
        lc.lift(splats, cameras, views, preset="row-sum", engine=engine, checkpoint=kind(tmp_path / "kept"))
        for kind in (str, Path)
    ]
    assert torch.equal(made[0].features, made[1].features) and any((tmp_path / "kept").iterdir())


def test_warnings_of_a_lift_are_logged_once_where_nobody_shows_the_plan(scene, caplog):
    _, splats, cameras, views = scene
    turned = {name: lc.FeatureGrid(torch.ones(64, 4, 3)) for name in views}
    made = lc.lift(splats, cameras, turned, preset="row-sum")
    assert any("check that they are [rows, columns]" in warning for warning in made.diagnostics["warnings"])
    assert [record.getMessage() for record in caplog.records].count(made.diagnostics["warnings"][-1]) == 1
    assert {record.getMessage() for record in caplog.records} >= set(made.diagnostics["warnings"])
    caplog.clear()
    lc.lift(splats, cameras, turned, preset="row-sum", on_plan=lambda plan: None)
    assert not caplog.records


@contextmanager
def default_dtype(dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


MODES = {
    "inference": torch.inference_mode,
    "float64": lambda: default_dtype(torch.float64),
    "bfloat16": lambda: default_dtype(torch.bfloat16),
    "autocast": lambda: torch.autocast("cpu", torch.bfloat16),
    "another device": lambda: torch.device("meta"),  # where there is one, a card
}


@pytest.mark.parametrize("mode", MODES)
def test_torch_modes_change_no_bit_and_hold_in_the_callers_iterator(scene, mode):
    _, splats, cameras, views = scene
    vectors, values = np.eye(2, views["v0"].codebook.shape[1]), np.linspace(0, 1, splats.count)

    def modes():
        modes = torch.is_inference_mode_enabled(), torch.is_autocast_enabled("cpu")
        return *modes, torch.get_default_dtype(), torch.get_default_device()

    def found(given):
        made = lc.lift(splats, cameras, given, cg_steps=1, reference_channels=2)
        assert lc.plan(splats, cameras, views).views == made.views
        answer = made.query(vectors, splats=splats)
        W, image = lc.region_weights(splats, cameras, views), lc.render(splats, cameras["v0"], values)
        tuples = lc.lift(splats, cameras, views, preset="row-sum").features
        return made.features, made.total_weight, answer.scores, W.weight, image, tuples

    def iterator(seen):
        for name, view in views.items():
            lc.render(splats, cameras["v0"], values)  # a call within a call
            seen.append(modes())
            yield name, view

    usual, seen = found(views), []
    with MODES[mode]():
        around = modes()
        within = found(iterator(seen))
        assert modes() == around and set(seen) == {around}
    assert all(torch.equal(one, other) for one, other in zip(usual, within, strict=True))


def test_two_threads_lift_alike_beside_another_default_dtype(scene):
    _, splats, cameras, views = scene
    usual = lc.lift(splats, cameras, views).features
    with default_dtype(torch.float64), ThreadPoolExecutor(2) as pool:
        found = [pool.submit(lc.lift, splats, cameras, views) for _ in range(4)]
        assert all(torch.equal(one.result().features, usual) for one in found)
        assert torch.get_default_dtype() == torch.float64


def test_every_public_value_is_shown_in_a_line_that_says_its_size(scene):
    _, splats, cameras, views = scene
    made = lc.lift(splats, cameras, views, aggregation=True, aggregation_cluster_size=2)
    vectors = torch.eye(2, made.features.shape[1])
    answer, words = made.query(vectors, splats=splats, threshold=0.1), ["a" * 90, "b"]
    segmentation, catalogue = made.segment(words, vectors, splats), made.objects(splats, words, vectors)
    sized = [splats, made, lc.region_weights(splats, cameras, views), answer, segmentation]
    sized += [lc.plan(splats, cameras, views), lc.plan_photos(splats, cameras)]
    long = lc.LiftSettings.of(**dict(lc.LiftSettings.of(speed="fast")))
    others = [cameras, cameras["v0"].replace(name="x" * 300), *views.values(), long, lc.LiftSettings.of()]
    others += [
        answer.objects,
        *(answer.objects.objects if answer.objects else ()),
        *segmentation.named_words,
        catalogue,
        *catalogue.objects,
    ]
    others += [lc.CompositingParams(), lc.CompositingParams(stride=3), lc.LocalEngine(), lc.open_encoder("lvis")]
    opened, box = made.scene(splats, cameras), ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    query = lc.Query(text=["a" * 99], like=["splat:1", (1.0,) * made.features.shape[1]], absent="keep")
    found = opened.ask(lc.Query(like=["splat:1"]))
    thing = {"splats": 1, "share": 0.5, "score": 0.5, "box": box}
    others += [opened, query, found, opened.objects(found), opened.view_mask(found, "v0")]
    others += [lc.FeatureGrid(np.ones((3, 4, 5))), lc.Picture(camera=cameras["v0"])]
    others += [models.OwnCamera.of(cameras["v0"])]
    sized_thing: dict[str, Any] = thing | {"centre": box[0], "size": box[1]}
    others += [lc.SelectedObject(**sized_thing), opened.world, lc.WorldFrame(up=(0, -3, 0), metres_per_unit=0.1)]
    others += [lc.NamedSplats(word="a" * 99, row=0, value=1, colour=(1, 2, 3), margin=0.1, threshold=0.2, **thing)]
    others += [lc.SceneObject(id=0, name=None, views=("v",) * 99, feature=(0.1,) * 512, **sized_thing)]
    others += [lc.CoveringRegion(example="region:v:0:1", view="v" * 99, level=0, region=1, share=0.5)]
    classes = {value for name in lc.__all__ if isinstance(value := getattr(lc, name), type)}
    no_values = [kind for kind in classes if issubclass(kind, Exception) or getattr(kind, "_is_protocol", False)]
    classes -= {*no_values, lc.RayEngine, lc.Checkpoint, lc.Kernel}  # which needs Ray; a folder; a name
    assert classes <= {kind for value in (*sized, *others) for kind in type(value).__mro__}
    for value in (*sized, *others):
        line = repr(value)
        assert line.startswith(type(value).__name__ + "(") and line.endswith(")")
        assert len(line) <= 120 and "\n" not in line and len(str(value)) <= 120
    assert all(str(splats.count) in repr(value) for value in sized)
    assert "[3, 4, 5]" in repr(lc.FeatureGrid(np.ones((3, 4, 5)))) and "stride=3" in repr(
        lc.CompositingParams(stride=3)
    )


def test_what_a_caller_set_stays_when_a_call_names_another_speed_or_preset() -> None:
    settings = lc.LiftSettings.of(speed="fast", stride=3, preset="default")
    assert lc.LiftSettings.from_preset(settings, {"speed": "balanced"}) == lc.LiftSettings.of(
        speed="balanced", stride=3
    )
    fast = lc.LiftSettings.of(speed="fast")
    same = lc.LiftSettings.of(speed="fast", stride=fast.stride)  # the speed's own value, but asked for
    assert lc.LiftSettings.from_preset(same, {"speed": "exact"}).stride == fast.stride
    assert lc.LiftSettings.from_preset(fast, {"speed": "exact"}) == lc.LiftSettings.of(speed="exact")
    loaded = lc.LiftSettings.model_validate_json(same.model_dump_json())
    assert loaded == same
