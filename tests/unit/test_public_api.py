"""``import liftcore as lc``: public names, imports, lifts of values in memory, and progress of a lift."""

import ast
import logging
from contextlib import contextmanager
from importlib import import_module
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.lifting.files import lift_files
from tests.scenes import observed, write_scene

ROOT = Path(__file__).parents[2]
MOST_NAMES = 60  # of `import liftcore`
MOST_OF_ALL = 117  # with those of the public modules: each more must be worth its place
MODULES = ("cli", "errors", "evaluate", "files", "models", "text", "text.table")
USERS = [path for folder in ("liftcore/cli", "service") for path in sorted((ROOT / folder).rglob("*.py"))]


@pytest.fixture
def scene(tmp_path):
    """The paths of a scene of three views, and its values."""
    paths = write_scene(tmp_path, 3)
    return paths, lc.read_splats(paths[0]), lc.read_cameras(paths[1]), {f"v{k}": observed(3, k) for k in range(3)}


def public_names() -> dict[str, list[str]]:
    """Return the public names of each public module."""
    return {name: import_module(name).__all__ for name in ("liftcore", *(f"liftcore.{module}" for module in MODULES))}


def test_public_names_are_few_and_load():
    names_by_module = public_names()
    assert len(names_by_module["liftcore"]) <= MOST_NAMES and len({*chain(*names_by_module.values())}) <= MOST_OF_ALL
    for module, names in names_by_module.items():
        assert len(names) == len(set(names))
        assert all(getattr(import_module(module), name) is not None for name in names)
        assert module == "liftcore" or (import_module(module).__doc__ or "").startswith("Public: ")


def imported_names(path):
    """Return (module, name) of each import from liftcore in a file, at any depth."""
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "liftcore":
            names += [(node.module, name.name) for name in node.names]
        if isinstance(node, ast.Import):
            names += [(name.name, "") for name in node.names if name.name.startswith("liftcore.")]
    return names


@pytest.mark.parametrize("path", USERS, ids=lambda path: str(path.relative_to(ROOT)))
def test_command_line_and_service_import_public_names_alone(path):
    """Commands and routes need nothing that a user's program cannot import: add a public name where they do."""
    public = public_names()
    public["liftcore"] = [*public["liftcore"], "__version__", *MODULES]
    in_library = path.is_relative_to(ROOT / "liftcore")  # files of the command line import each other
    private = [
        (module, name)
        for module, name in imported_names(path)
        if name not in public.get(module, ()) and not (in_library and module.startswith("liftcore.cli"))
    ]
    assert not private


def test_iterator_is_taken_one_view_at_a_time_and_once(scene):
    _, splats, cameras, views = scene
    read_names = []

    def each():
        for name, view in views.items():
            read_names.append(name)
            yield name, view
        yield "nobody", views["v0"]

    result = lc.lift(splats, cameras, each())
    assert read_names == list(views)
    assert result.diagnostics["views_without_camera"] == ["nobody"]


def test_weights_at_pixels_are_their_renders(scene):
    _, splats, cameras, _ = scene
    pixels = np.array([[0, 0], [20, 15], [9, 11], [20, 15]])
    answers = lc.weights_at(splats, cameras["v0"], pixels)
    image = lc.render(splats, cameras["v0"], torch.eye(splats.count))
    assert len(answers) == len(pixels) and any(len(rows) for rows, _ in answers)
    for (x, y), (rows, weights) in zip(pixels, answers, strict=True):
        assert torch.allclose(torch.zeros(splats.count).index_add(0, rows, weights), image[y, x], atol=1e-6)
        depths = splats.means.numpy()[rows] @ cameras["v0"].viewmat[2, :3]
        assert (np.diff(depths) >= -1e-5).all()
    for wrong in ([(0.5, 0)], [0, 0], [(cameras["v0"].width, 0)], [(0, -1)]):
        with pytest.raises(lc.InvalidSettings, match="pixels: expected"):
            lc.weights_at(splats, cameras["v0"], wrong)  # pyright: ignore[reportArgumentType]
    with pytest.raises(lc.InvalidCameras, match="camera: expected a Camera"):
        lc.weights_at(splats, "v0", pixels)  # pyright: ignore[reportArgumentType]


def test_warnings_of_memory_go_to_the_callback_else_to_the_log(tmp_path, monkeypatch, caplog):
    little_memory = "the rest of the lift may take 9.0 GiB and 1.0 GiB are free"
    monkeypatch.setattr("liftcore.lifting.planning.plan.check_memory", lambda parts, free: [little_memory])
    splats, cameras, pack = write_scene(tmp_path, 3)
    plans = []

    def refuse(plan):
        raise InterruptedError(plan.kernel)

    with pytest.raises(InterruptedError, match="3dgs"):  # an error of the callback stops the lift
        lift_files(splats, cameras, [pack], lc.LiftSettings.of(), on_plan=refuse)
    with caplog.at_level(logging.WARNING):
        lift_files(splats, cameras, [pack], lc.LiftSettings.of(), on_plan=plans.append)
        assert plans[0].warnings == (little_memory,) and little_memory not in caplog.text
        lift_files(splats, cameras, [pack], lc.LiftSettings.of())
        assert caplog.text.count(little_memory) == 1


def test_settings_and_keywords_beside_them_are_one(scene):
    _, splats, cameras, views = scene
    settings = lc.LiftSettings.of(preset="row-sum", stride=2)
    full = lc.region_weights(splats, cameras, views, preset="row-sum")
    strided = lc.region_weights(splats, cameras, views, settings, view_stride=2)
    assert lc.lift(splats, cameras, views, settings, view_stride=2).settings.stride == 2
    assert lc.plan(splats, cameras, views, settings, view_stride=2).views == strided.views == ("v0", "v2")
    assert float(full.weight.sum()) > 2 * float(strided.weight.sum())
    merged = lc.lift(splats, cameras, views, lc.LiftSettings.of(quality="fast", seed=3), quality="exact").settings
    assert merged == lc.LiftSettings.of(quality="exact", seed=3, antialiased=False)  # which auto came to
    assert lc.lift(splats, cameras, views, lc.LiftSettings.of(), robust=False).confidence is None


def test_render_refuses_to_drop_a_gradient_that_is_recorded(scene):
    _, splats, cameras, _ = scene
    values = torch.ones(splats.count, 2, requires_grad=True)
    with pytest.raises(lc.InvalidSettings, match=r"values: .*gradient.*values\.detach\(\)"):
        lc.render(splats, cameras["v0"], values)
    expected = lc.render(splats, cameras["v0"], values.detach())
    for mode in (torch.no_grad(), torch.inference_mode()):
        with mode:
            assert torch.equal(lc.render(splats, cameras["v0"], values), expected)


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
    "another device": lambda: torch.device("meta"),  # as a GPU may be the default
}


@pytest.mark.parametrize("mode", MODES)
def test_torch_modes_change_no_bit_and_hold_in_the_callers_iterator(scene, mode):
    _, splats, cameras, views = scene
    vectors, values = np.eye(2, views["v0"].codebook.shape[1]), np.linspace(0, 1, splats.count)

    def modes():
        modes = torch.is_inference_mode_enabled(), torch.is_autocast_enabled("cpu")
        return *modes, torch.get_default_dtype(), torch.get_default_device()

    def tensors_of(sources):
        result = lc.lift(splats, cameras, sources, reference_channels=2)
        assert lc.plan(splats, cameras, views).views == result.views
        answer = result.query(vectors, splats=splats)
        W, image = lc.region_weights(splats, cameras, views), lc.render(splats, cameras["v0"], values)
        tuples = lc.lift(splats, cameras, views, preset="row-sum").features
        return result.features, result.total_weight, torch.from_numpy(answer.scores), W.weight, image, tuples

    def iterator(log):
        for name, view in views.items():
            lc.render(splats, cameras["v0"], values)  # a call within a call
            log.append(modes())
            yield name, view

    expected, modes_of_views = tensors_of(views), []
    with MODES[mode]():
        around = modes()
        within = tensors_of(iterator(modes_of_views))
        assert modes() == around and set(modes_of_views) == {around}
    assert all(torch.equal(a, b) for a, b in zip(expected, within, strict=True))


def test_what_a_caller_set_stays_when_a_call_names_another_quality_or_preset() -> None:
    settings = lc.LiftSettings.of(quality="fast", stride=3, preset="default")
    assert lc.LiftSettings.from_preset(settings, {"quality": "balanced"}) == lc.LiftSettings.of(
        quality="balanced", stride=3
    )
    fast = lc.LiftSettings.of(quality="fast")
    explicit = lc.LiftSettings.of(quality="fast", stride=fast.stride)  # the default of this level, but explicit
    assert lc.LiftSettings.from_preset(explicit, {"quality": "exact"}).stride == fast.stride
    assert lc.LiftSettings.from_preset(fast, {"quality": "exact"}) == lc.LiftSettings.of(quality="exact")
    loaded = lc.LiftSettings.model_validate_json(explicit.model_dump_json())
    assert loaded == explicit
