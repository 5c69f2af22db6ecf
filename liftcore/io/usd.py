"""Writer of OpenUSD 26: a ``ParticleField3DGaussianSplat`` of schema usdVol for each object.

Positions, linear scales and opacities, quaternions with the real part first, and harmonics particle by particle, the
constant term first, ordered as 3DGS has them. The frame is right, up, back (+Y up). The stage's up axis and metres of
a unit are those of the splats where they are known (`liftcore.scene.world`); custom data of its layer record which of
them are, as validators require both.

Columns of splats are primvars of the fields, and ``splatlift_row`` their rows. A field has the object's name by
``SemanticsLabelsAPI:class``. Files are written by ``usd-core`` (the extra ``formats``).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from importlib import import_module
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidSplats, Unavailable
from liftcore.io.labels import IDS, KINDS, stored_columns
from liftcore.io.quantised import gaussians_in
from liftcore.runtime.folders import scratch_folder

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

TO_FILE = np.diag([1.0, -1.0, -1.0])  # RDF to RUB, and back
MODULES = ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdSemantics", "UsdUtils", "UsdVol", "Vt")
FIELD = "ParticleField3DGaussianSplat"
WORLD = "splatlift_world"  # of the layer's custom data: up and metres a unit as JSON, null where not known
ROW = "splatlift_row"  # primvar of the fields of split splats: their original rows
DOCUMENT = "splatlift"  # of the field's custom data: the labels' document as JSON


def open_library() -> Any:
    """Import the modules of OpenUSD, and return them by their names."""
    try:
        modules = SimpleNamespace(**{name: import_module(f"pxr.{name}") for name in MODULES})
    except ImportError:
        modules = None
    if not hasattr(getattr(modules, "UsdVol", None), FIELD):
        hint = "pip install 'splatlift[formats]'"
        raise Unavailable("USD", expected="usd-core 26.3 or later", got="none", hint=hint)
    return modules


def usd_blocks(splats: Splats, document: Mapping[str, Any] | None, suffix: str = ".usdc") -> Iterator[bytes]:
    """Yield the bytes of a USD file of any splats (`gaussian_rows`), with their extras and the labels' document."""
    pxr, columns = open_library(), stored_columns(splats)
    with scratch_folder("splatlift-") as folder:
        path = folder / "scene.usdc"  # which a .usdz packs
        stage = pxr.Usd.Stage.CreateNew(str(path))
        pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
        world = splats.world
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0 if world.metres_per_unit is None else world.metres_per_unit)
        stage.SetMetadataByDictKey("customLayerData", WORLD, world.model_dump_json())
        root = pxr.UsdGeom.Xform.Define(stage, "/Scene")
        stage.SetDefaultPrim(root.GetPrim())
        if any(splats.origin):
            place = world.placement(TO_FILE, in_metres=False)[:3, :3] @ TO_FILE @ splats.origin
            root.AddTranslateOp().Set(pxr.Gf.Vec3d(*place.tolist()))
        if (rotation := world.upright(TO_FILE).tolist())[0] < 1:
            root.AddOrientOp(pxr.UsdGeom.XformOp.PrecisionDouble).Set(pxr.Gf.Quatd(*rotation))
        names = {row[IDS[0]]: row.get("name") for row in (document or {}).get(KINDS[0], ())}
        ids = columns.get(IDS[0], np.zeros(splats.count, np.int32))
        for number, rows in _instances(ids):
            fields = {name: column[rows] for name, column in columns.items()} | {ROW: rows.astype("i4")}
            prim = _write_field(stage, f"instance_{number}" if number else "Splats", splats[rows], fields)
            if (name := names.get(number)) is not None:
                pxr.UsdSemantics.LabelsAPI.Apply(prim, "class").CreateLabelsAttr([name])
        if document:
            first = next(iter(stage.GetPrimAtPath("/Scene").GetChildren()))
            first.SetCustomDataByKey(DOCUMENT, json.dumps(document, ensure_ascii=False))
        stage.GetRootLayer().Save()
        del stage
        if suffix == ".usdz":
            package = path.with_suffix(".usdz")
            if not pxr.UsdUtils.CreateNewUsdzPackage(pxr.Sdf.AssetPath(str(path)), str(package)):
                raise InvalidSplats("splats", expected="a package", got="an error of usd-core", hint="write a .usdc")
            path = package
        yield path.read_bytes()


def _write_field(stage: Any, name: str, splats: Splats, columns: Mapping[str, np.ndarray]) -> Any:
    """Write a particle field, and return its prim."""
    pxr = open_library()
    rows = gaussians_in(splats, TO_FILE)
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/Scene/{name}")

    def vectors(values: np.ndarray) -> Any:
        return pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, "f4"))

    field.CreatePositionsAttr(vectors(rows.means))
    field.CreateScalesAttr(vectors(rows.scales))
    # In memory the real part is last.
    field.CreateOrientationsAttr(pxr.Vt.QuatfArray.FromNumpy(np.ascontiguousarray(rows.quats)))
    field.CreateOpacitiesAttr(pxr.Vt.FloatArray.FromNumpy(rows.opacities))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(round(rows.sh.shape[1] ** 0.5) - 1)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(vectors(rows.sh.reshape(-1, 3)))
    field.CreateSortingModeHintAttr("cameraDistance")
    reach = 3 * rows.scales.max(axis=1, keepdims=True)
    low, high = (rows.means - reach).min(axis=0).tolist(), (rows.means + reach).max(axis=0).tolist()
    field.CreateExtentAttr(pxr.Vt.Vec3fArray([pxr.Gf.Vec3f(*low), pxr.Gf.Vec3f(*high)]))
    primvars = pxr.UsdGeom.PrimvarsAPI(field)
    for key, column in columns.items():
        if not pxr.Sdf.Path.IsValidIdentifier(key):
            raise InvalidSplats("columns", expected="names of letters, digits and underscores", got=repr(key))
        is_float = column.dtype.kind == "f"
        kind = pxr.Sdf.ValueTypeNames.FloatArray if is_float else pxr.Sdf.ValueTypeNames.IntArray
        array = pxr.Vt.FloatArray if is_float else pxr.Vt.IntArray
        primvar = primvars.CreatePrimvar(key, kind, pxr.UsdGeom.Tokens.vertex)
        primvar.Set(array.FromNumpy(column))
    return field.GetPrim()


def _instances(instances: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Yield each number of a column of ids, and its rows."""
    order = np.argsort(instances, kind="stable")
    numbers, firsts = np.unique(instances[order], return_index=True)
    yield from zip(numbers.tolist(), np.split(order, firsts[1:]), strict=True)
