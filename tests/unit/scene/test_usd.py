"""OpenUSD particle fields, written and read back, with a subset of points an object."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from liftcore.errors import InvalidSplats, Unavailable
from liftcore.evaluate.inspect import inspect_file
from liftcore.io.kinds import SplatFormat
from liftcore.io.splats import format_of, labelled, read_labels, read_places, read_splats, write_splats
from liftcore.io.usd import open_library, usd_blocks
from liftcore.scene.kernel import Kernel
from tests.unit.scene.test_gltf import P, assert_same, labels, some_splats


def has_usd() -> bool:
    try:
        return bool(open_library())
    except Unavailable:
        return False


HAS_USD = has_usd()
needs_usd = pytest.mark.skipif(not HAS_USD, reason="usd-core is not installed: it is the extra formats")


@pytest.mark.skipif(HAS_USD, reason="usd-core is installed")
def test_without_the_library_the_extra_is_named(tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match=r"splatlift\[formats\]"):
        write_splats(tmp_path / "s.usdc", some_splats())
    (tmp_path / "t.usdc").write_bytes(b"PXR-USDC" + bytes(90))
    with pytest.raises(Unavailable, match=r"splatlift\[formats\]"):
        read_splats(tmp_path / "t.usdc")


def test_a_scene_that_may_lead_elsewhere_is_not_taken_from_strangers(tmp_path: Path) -> None:
    (tmp_path / "t.usdc").write_bytes(b"PXR-USDC" + bytes(90))
    assert format_of(tmp_path / "t.usdc") is SplatFormat.USD
    with pytest.raises(InvalidSplats, match="may lead to other files"):
        inspect_file(tmp_path / "t.usdc", "splats", trusted=False)


@needs_usd
@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_every_kernel_comes_back_as_the_gaussians_that_were_written(
    kernel: Kernel, suffix: str, tmp_path: Path
) -> None:
    write_splats(tmp_path / f"s{suffix}", some_splats(kernel))
    assert format_of(tmp_path / f"s{suffix}") is SplatFormat.USD
    assert_same(read_splats(tmp_path / f"s{suffix}"), some_splats(kernel))


@needs_usd
def test_objects_are_subsets_index_for_index_and_validators_find_nothing(tmp_path: Path) -> None:
    pxr = open_library()
    expected = labels()
    write_splats(tmp_path / "s.ply", some_splats())
    (tmp_path / "s.usdc").write_bytes(b"".join(labelled(tmp_path / "s.ply", expected, ".usdc")))
    actual = read_labels(tmp_path / "s.usdc")
    assert {kind: actual.document[kind] for kind in expected.document} == expected.document
    for name, values in expected.columns.items():
        np.testing.assert_array_equal(actual.columns[name], values)
    stage = pxr.Usd.Stage.Open(str(tmp_path / "s.usdc"))
    for row in expected.document["instances"]:
        subset = pxr.UsdGeom.Subset.Get(stage, f"/Scene/Splats/instance_{row['instance_id']}")
        inside = np.flatnonzero(expected.columns["instance_id"] == row["instance_id"])
        assert list(subset.GetIndicesAttr().Get()) == inside.tolist()
        assert list(pxr.UsdSemantics.LabelsAPI(subset.GetPrim(), "class").GetLabelsAttr().Get()) == [row["name"]]
    validation = import_module("pxr.UsdValidation")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10 and not validation.ValidationContext(validators).Validate(stage)


@needs_usd
@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
@pytest.mark.parametrize("kernel", Kernel)
def test_objects_as_prims_of_their_own_come_back_row_for_row(kernel: Kernel, suffix: str, tmp_path: Path) -> None:
    pxr, expected = open_library(), labels()
    write_splats(tmp_path / "s.ply", some_splats(kernel))
    (tmp_path / f"s{suffix}").write_bytes(b"".join(labelled(tmp_path / "s.ply", expected, suffix, prims=True)))
    actual, splats = read_labels(tmp_path / f"s{suffix}"), read_splats(tmp_path / f"s{suffix}")
    assert_same(splats, some_splats(kernel))
    np.testing.assert_array_equal(read_places(tmp_path / f"s{suffix}"), splats.positions())
    assert {kind: actual.document[kind] for kind in expected.document} == expected.document
    assert actual.columns.keys() == expected.columns.keys()
    for name, values in expected.columns.items():
        np.testing.assert_array_equal(actual.columns[name], values)
    stage = pxr.Usd.Stage.Open(str(tmp_path / f"s{suffix}"))
    for row in expected.document["instances"]:
        prim = stage.GetPrimAtPath(f"/Scene/instance_{row['instance_id']}")
        inside = np.flatnonzero(expected.columns["instance_id"] == row["instance_id"])
        assert len(prim.GetAttribute("positions").Get()) == len(inside)
        assert list(pxr.UsdSemantics.LabelsAPI(prim, "class").GetLabelsAttr().Get()) == [row["name"]]
    validation = import_module("pxr.UsdValidation")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10 and not validation.ValidationContext(validators).Validate(stage)
    stage.RemovePrim("/Scene/instance_1")
    stage.GetRootLayer().Export(str(tmp_path / "cut.usdc"))
    assert read_splats(tmp_path / "cut.usdc").count == P - np.count_nonzero(expected.columns["instance_id"] == 1)


@needs_usd
def test_prims_are_of_usd_and_of_labels_alone(tmp_path: Path) -> None:
    write_splats(tmp_path / "s.ply", some_splats())
    with pytest.raises(InvalidSplats, match="which have prims"):
        labelled(tmp_path / "s.ply", labels(), ".glb", prims=True)
    with pytest.raises(InvalidSplats, match="prims: expected a column instance_id"):
        b"".join(usd_blocks(some_splats(), prims=True))


@needs_usd
def test_stages_of_others_are_turned_and_their_subsets_are_instances(tmp_path: Path) -> None:
    pxr = open_library()
    write_splats(tmp_path / "s.usdc", some_splats(), {"instance_id": np.arange(P) % 3})
    stage = pxr.Usd.Stage.Open(str(tmp_path / "s.usdc"))
    pxr.UsdGeom.PrimvarsAPI(pxr.UsdVol.ParticleField3DGaussianSplat.Get(stage, "/Scene/Splats")).RemovePrimvar(
        "instance_id"
    )
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/Scene")).SetTranslate((1.0, 2.0, 3.0))
    stage.GetRootLayer().Export(str(tmp_path / "t.usda"))
    actual = read_splats(tmp_path / "t.usda")
    # What was up (z) is minus y, what was y is to the front.
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ np.diag([1.0, -1.0, -1.0])
    assert_same(actual, some_splats().transformed(rotation=turn, translation=[1.0, -3.0, 2.0]))
    assert sorted(np.unique(actual.extras["instance_id"], return_counts=True)[1].tolist()) == [13, 13, 14]


@needs_usd
@pytest.mark.parametrize("degree", [-1, 2, 100_000, None])
def test_harmonics_that_do_not_fit_their_degree_are_refused(degree: int | None, tmp_path: Path) -> None:
    pxr = open_library()
    write_splats(tmp_path / "s.usdc", some_splats())
    stage = pxr.Usd.Stage.Open(str(tmp_path / "s.usdc"))
    attribute = stage.GetPrimAtPath("/Scene/Splats").GetAttribute("radiance:sphericalHarmonicsDegree")
    attribute.Block() if degree is None else attribute.Set(degree)
    stage.GetRootLayer().Export(str(tmp_path / "t.usdc"))
    with pytest.raises(InvalidSplats, match=r"harmonics|sphericalHarmonics"):
        read_splats(tmp_path / "t.usdc")


@needs_usd
def test_columns_come_back_or_are_refused(tmp_path: Path) -> None:
    ids = np.tile([3.0, np.nan, -1.0, 4e9], P // 4)
    write_splats(tmp_path / "s.usdc", some_splats(), {"instance_id": ids})
    assert read_labels(tmp_path / "s.usdc").columns["instance_id"].tolist() == [3, 0, 0, 0] * (P // 4)
    with pytest.raises(InvalidSplats, match="letters, digits and underscores"):
        write_splats(tmp_path / "s.usdc", some_splats(), {"a.b": np.zeros(P)})
