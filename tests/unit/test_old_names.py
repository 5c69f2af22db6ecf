"""Old public names: read in files, settings and calls like the new ones, and refused together with other values."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import liftcore as lc
from liftcore.cli import build_parser
from liftcore.cli.lift import pairs_of, settings_of
from liftcore.values.lift import LiftMetadata
from liftcore.values.lift_file import FORMATS, OLD_DIAGNOSTICS, OLD_TENSORS
from liftcore.values.region_weights import OLD_TENSORS as OLD_WEIGHTS
from tests.scenes import observed, write_scene
from tests.unit.solve.sparse_views import random_view


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> lc.LiftResult:
    """A lift of a small scene."""
    splats, cameras, _ = write_scene(tmp_path_factory.mktemp("scene"), 3)
    views = {f"v{k}": observed(3, k) for k in range(3)}
    return lc.lift(lc.read_splats(splats), lc.read_cameras(cameras), views)


def old_names(values: dict[str, Any], aliases: Mapping[str, str]) -> dict[str, Any]:
    """Return values with old names in place of new ones."""
    olds = {new: old for old, new in aliases.items()}
    return {olds.get(name, name): value for name, value in values.items()}


def read_file(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Return the tensors and the metadata of a lift file."""
    with safe_open(path, "pt") as file:
        return load_file(path), json.loads(file.metadata()["splatlift"])


def write_file(path: Path, tensors: dict[str, torch.Tensor], metadata: dict[str, Any]) -> Path:
    save_file(tensors, path, {"splatlift": json.dumps(metadata)})
    return path


@pytest.mark.parametrize("number", FORMATS)
def test_lift_file_of_old_names_opens_with_the_same_values(lift: lc.LiftResult, tmp_path: Path, number: str) -> None:
    lift.save(tmp_path / "new.safetensors")
    tensors, metadata = read_file(tmp_path / "new.safetensors")
    assert metadata["format"] == FORMATS[-1] and not OLD_TENSORS.keys() & tensors.keys()
    assert not OLD_DIAGNOSTICS.keys() & metadata["diagnostics"].keys()
    settings = old_names(metadata["settings"], lc.LiftSettings.old_names)
    metadata |= {"format": number, "settings": settings}
    metadata["diagnostics"] = old_names(metadata["diagnostics"], OLD_DIAGNOSTICS)
    metadata = old_names(metadata, LiftMetadata.old_names)
    old = lc.load_lift(write_file(tmp_path / "old.safetensors", old_names(tensors, OLD_TENSORS), metadata))
    for name in OLD_TENSORS.values():
        assert torch.equal(getattr(old, name), getattr(lift, name))
    assert old.diagnostics == lift.diagnostics and old.settings == lift.settings


@pytest.mark.parametrize("old", OLD_TENSORS)
def test_lift_file_with_both_names_and_other_values_is_refused(lift: lc.LiftResult, tmp_path: Path, old: str) -> None:
    lift.save(tmp_path / "lift.safetensors")
    tensors, metadata = read_file(tmp_path / "lift.safetensors")
    new = OLD_TENSORS[old]
    lc.load_lift(write_file(tmp_path / "same.safetensors", tensors | {old: tensors[new].clone()}, metadata))
    other = ~tensors[new] if tensors[new].dtype == torch.bool else tensors[new] + 1
    with pytest.raises(lc.InvalidLift, match=f"{old} is the old name of {new}"):
        lc.load_lift(write_file(tmp_path / "other.safetensors", tensors | {old: other}, metadata))


def test_lift_file_of_a_later_format_is_refused_by_its_format(lift: lc.LiftResult, tmp_path: Path) -> None:
    lift.save(tmp_path / "lift.safetensors")
    tensors, metadata = read_file(tmp_path / "lift.safetensors")
    metadata["format"] = "splatlift-lift/999"
    for columns in (tensors, {"features": tensors["features"]}):
        with pytest.raises(lc.InvalidLift, match="splatlift-lift/999"):
            lc.load_lift(write_file(tmp_path / "later.safetensors", columns, metadata))


@pytest.mark.parametrize("old", OLD_TENSORS)
def test_old_attributes_and_keywords_of_a_lift_are_deprecated(lift: lc.LiftResult, old: str) -> None:
    new = OLD_TENSORS[old]
    with pytest.deprecated_call(match=f"{old} is now {new}"):
        assert getattr(lift, old) is getattr(lift, new)
    columns = {
        name: getattr(lift, name)
        for name in ("features", "total_weight", "view_consistency", "has_feature", "metadata")
    }
    with pytest.deprecated_call(match=f"{old} is now {new}"):
        result = lc.LiftResult(**old_names(columns, {old: new}))
    assert getattr(result, new) is getattr(lift, new)


@pytest.mark.parametrize("old", OLD_DIAGNOSTICS)
def test_old_names_of_diagnostics_are_deprecated_and_replied_beside_the_new(lift: lc.LiftResult, old: str) -> None:
    new, reply = OLD_DIAGNOSTICS[old], lift.diagnostics_of_reply(lift.diagnostics)
    assert reply[old] == reply[new] and old not in list(lift.diagnostics)
    for diagnostics in (lift.diagnostics, lift[:2].diagnostics):
        for read in (itemgetter(old), lambda values: values.get(old), lambda values: values.copy()[old]):
            with pytest.deprecated_call(match=f"{old} is now {new}"):
                assert read(diagnostics) == lift.diagnostics[new]
        assert old in diagnostics and old not in list(diagnostics) and diagnostics.get("nothing", 5) == 5
    with pytest.raises(KeyError, match="nothing"):
        lift.diagnostics["nothing"]
    with pytest.raises(lc.InvalidLift, match=f"{old} is the old name of {new}"):
        lift.diagnostics_of_reply({old: 0.0, new: 0.5})


def settings_by_old_names(old: str, value: object) -> dict[str, Callable[[], lc.LiftSettings]]:
    """Return settings with one old name, by the ways in which they come."""
    text, parser, new = [f"{old}={value}"], build_parser(), lc.LiftSettings.old_names[old]
    other = lc.LiftSettings.of().model_dump(mode="json")[new]
    return {
        "keyword": lambda: lc.LiftSettings.of(**{old: value}),
        "json": lambda: lc.LiftSettings.of_json({old: value}),
        "saved": lambda: lc.LiftSettings.model_validate_json(json.dumps({old: value})),
        "set": lambda: lc.LiftSettings.of(**pairs_of(text)),
        "option": lambda: settings_of(parser.parse_args(["lift", "s", "c", "f", "-o", "o", "--set", *text])),
        "changed": lambda: lc.LiftSettings.from_preset(lc.LiftSettings.of(**{new: other}), {old: value}),
    }


def test_method_and_argument_of_a_class_are_read_by_old_names() -> None:
    settings: Any = lc.LiftSettings
    with pytest.deprecated_call(match="chosen is now from_preset"):
        assert settings.chosen("row-sum", {"seed": 3}) == lc.LiftSettings.from_preset("row-sum", {"seed": 3})
    with pytest.deprecated_call(match="others is now changes"):
        assert settings.from_preset("row-sum", others={"seed": 3}).seed == 3
    regions: Any = lc.Regions
    for make in (
        lambda: regions([[1]], torch.ones(1, 2), where="view 'a'"),
        lambda: lc.FeatureGrid(torch.ones(2), **{"where": "view 'a'"}),
    ):
        with (
            pytest.deprecated_call(match="where is now context"),
            pytest.raises(lc.InvalidFeatures, match="view 'a'"),
        ):
            make()


VALUES = {"certificate_rays": 7, "speed": "draft"}  # of settings with an old name


@pytest.mark.parametrize("way", settings_by_old_names("certificate_rays", 7))
@pytest.mark.parametrize("old", lc.LiftSettings.old_names)
def test_settings_are_read_by_old_names_and_written_by_new_ones(old: str, way: str) -> None:
    new, value = lc.LiftSettings.old_names[old], VALUES[old]
    settings = settings_by_old_names(old, value)[way]()
    assert getattr(settings, new) == value and new in settings.model_fields_set
    values = settings.model_dump(mode="json")
    assert values[new] == value and old not in values
    assert lc.LiftSettings.with_old_names(values)[old] == value
    with pytest.deprecated_call(match=f"{old} is now {new}"):
        assert getattr(settings, old) == value
    assert getattr(settings.model_copy(update={old: 0}), new) == 0


@pytest.mark.parametrize("old", lc.LiftSettings.old_names)
def test_settings_with_both_names_and_other_values_are_refused(old: str) -> None:
    new, value = lc.LiftSettings.old_names[old], VALUES[old]
    default = lc.LiftSettings.of().model_dump(mode="json")[new]
    assert getattr(lc.LiftSettings.of(**{old: value, new: value}), new) == value
    for make in (lambda values: lc.LiftSettings.of(**values), lc.LiftSettings.of_json):
        with pytest.raises(lc.InvalidSettings, match=f"{old} is the old name of {new}"):
            make({old: value, new: default})
    with pytest.raises(lc.InvalidSettings, match=f"{new}: expected one value"):
        pairs_of([f"{old}={value}", f"{new}={default}"])


def test_option_by_its_old_name_is_read_noted_and_hidden(capsys: pytest.CaptureFixture[str]) -> None:
    command, parser = ["lift", "s", "c", "f", "-o", "o"], build_parser()
    assert settings_of(parser.parse_args([*command, "--speed", "draft"])).quality == "draft"
    assert "--speed is now --quality" in capsys.readouterr().err
    assert settings_of(parser.parse_args([*command, "--speed", "draft", "--set", "speed=draft"])).quality == "draft"
    with pytest.raises(lc.InvalidSettings, match="--quality draft and --set quality=fast"):
        settings_of(parser.parse_args([*command, "--speed", "draft", "--set", "speed=fast"]))
    with pytest.raises(SystemExit):
        parser.parse_args([*command, "--speed", "draft", "--quality", "fast"])
    error = capsys.readouterr().err
    assert "--speed" in error and "--quality" in error
    with pytest.raises(SystemExit):
        parser.parse_args(["lift", "--help"])
    output = capsys.readouterr().out
    assert "--quality" in output and "--speed" not in output


def test_weights_file_of_the_first_format_opens(tmp_path: Path) -> None:
    weights = replace(random_view(0, 4, 30), views=("v0",))
    weights.save(tmp_path / "new.safetensors")
    tensors = old_names(load_file(tmp_path / "new.safetensors"), OLD_WEIGHTS)
    metadata = {"format": "splatlift-weights/1", "views": json.dumps(weights.views)}
    save_file(tensors, tmp_path / "old.safetensors", metadata)
    back = lc.RegionWeights.load(tmp_path / "old.safetensors")
    assert back.views == weights.views
    assert all(torch.equal(tensor, back.tensors()[name]) for name, tensor in weights.tensors().items())
