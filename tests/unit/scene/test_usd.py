"""OpenUSD particle fields, one an object, as OpenUSD itself reads them."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from liftcore.errors import InvalidSplats, Unavailable
from liftcore.io.quantised import gaussian_rows
from liftcore.io.splats import labelled, write_splats
from liftcore.io.usd import open_library
from liftcore.scene.kernel import Kernel
from liftcore.scene.quaternions import rotation_matrices
from liftcore.scene.world import WorldFrame
from tests.unit.scene.test_gltf import P, labels, some_splats

TO_FILE = np.diag([1.0, -1.0, -1.0])  # right, down, front to right, up, back


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


@needs_usd
@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_objects_are_particle_fields_with_their_rows_and_validators_find_nothing(
    kernel: Kernel, suffix: str, tmp_path: Path
) -> None:
    pxr, expected, splats = open_library(), labels(), some_splats(kernel)
    write_splats(tmp_path / "s.ply", splats)
    (tmp_path / f"s{suffix}").write_bytes(b"".join(labelled(tmp_path / "s.ply", expected, suffix)))
    stage = pxr.Usd.Stage.Open(str(tmp_path / f"s{suffix}"))
    (rows,) = gaussian_rows(splats)
    names = {row["instance_id"]: row["name"] for row in expected.document["instances"]}
    for number in (0, *names):
        prim = stage.GetPrimAtPath(f"/Scene/instance_{number}" if number else "/Scene/Splats")
        inside = np.flatnonzero(expected.columns["instance_id"] == number)

        def read(name: str, prim=prim) -> np.ndarray:
            return np.array(prim.GetAttribute(name).Get())

        assert read("primvars:splatlift_row").tolist() == inside.tolist()
        np.testing.assert_array_equal(read("primvars:class_id"), expected.columns["class_id"][inside])
        np.testing.assert_allclose(read("positions"), splats.positions()[inside] @ TO_FILE, atol=1e-6)
        np.testing.assert_allclose(read("scales"), rows.scales[inside], rtol=1e-6)
        np.testing.assert_allclose(read("opacities"), rows.opacities[inside], atol=1e-6)
        turns = rotation_matrices(np.roll(read("orientations"), 1, axis=1).astype(np.float64))
        np.testing.assert_allclose(turns, TO_FILE @ rotation_matrices(rows.quats[inside]), atol=1e-5)
        terms = read("radiance:sphericalHarmonicsCoefficients").reshape(len(inside), -1, 3)
        assert splats.sh is not None
        np.testing.assert_allclose(terms[:, 0], splats.sh[inside, 0], atol=1e-6)
        if number:
            label = pxr.UsdSemantics.LabelsAPI(prim, "class").GetLabelsAttr().Get()
            assert list(label) == [names[number]]
    validation = import_module("pxr.UsdValidation")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10 and not validation.ValidationContext(validators).Validate(stage)


@needs_usd
def test_stage_says_up_and_metres(tmp_path: Path) -> None:
    pxr = open_library()
    write_splats(tmp_path / "s.usdc", replace(some_splats(), world=WorldFrame(up=(3, 4, 0), metres_per_unit=0.25)))
    stage = pxr.Usd.Stage.Open(str(tmp_path / "s.usdc"))
    assert pxr.UsdGeom.GetStageMetersPerUnit(stage) == 0.25 and pxr.UsdGeom.GetStageUpAxis(stage) == "Y"


@needs_usd
def test_columns_that_usd_has_no_name_for_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidSplats, match="letters, digits and underscores"):
        write_splats(tmp_path / "s.usdc", some_splats(), {"a.b": np.zeros(P)})
