"""OpenUSD 26: ``ParticleField3DGaussianSplat`` of schema usdVol, with a subset of points an object.

Positions, linear scales and opacities, quaternions with the real part first, and harmonics particle by particle, the
constant term first, ordered as 3DGS has them. Files are written in the frame right, up, back (+Y up); on reading,
the stage's up axis and the transform of each particle field are applied. The stage's up axis and metres of a unit are
those of the splats where they are known (`liftcore.scene.world`); custom data of its layer record which of them are,
as validators require both.

Columns of splats are primvars of the field. An object is a ``GeomSubset`` with the element type ``point`` and
``SemanticsLabelsAPI:class``; it has no family, as validators accept families of point-based geometry alone. Or it is
a field of its own, with the original rows of its splats, which restore their order on reading.

Files are opened by ``usd-core`` (the extra ``formats``), which follows references to other files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidInput, InvalidSplats, Unavailable
from liftcore.io.labels import COLUMN, IDS, KINDS, id_column, rows_by_id, stored_columns
from liftcore.io.ply import MODEL
from liftcore.io.quantised import Fields, gaussian_rows, joined_fields, logits
from liftcore.runtime.folders import scratch_folder
from liftcore.scene.harmonics import band_rotation, constant_terms
from liftcore.scene.quaternions import product_matrix
from liftcore.scene.similarity import Similarity
from liftcore.scene.world import UNKNOWN, UPRIGHT, WorldFrame, world_of

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

TO_FILE = np.diag([1.0, -1.0, -1.0])  # RDF to RUB, and back
Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # a frame with z up to one with y up
MAX_DEGREE = 3  # of harmonics that are written
MOST_DEGREE = 4  # and read
MODULES = ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdSemantics", "UsdUtils", "UsdVol", "Vt")
FIELD = "ParticleField3DGaussianSplat"
WORLD = "splatlift_world"  # of the layer's custom data: up and metres a unit as JSON, null where not known
ROW = "splatlift_row"  # primvar of the fields of split splats: their original rows
DOCUMENT = "splatlift"  # of the field's custom data: the labels' document as JSON
HINT = "export it again, or as PLY"


def open_library() -> Any:
    """Import the modules of OpenUSD, and return them by their names.

    Raises:
        Unavailable: they are not installed.
    """
    try:
        modules = SimpleNamespace(**{name: import_module(f"pxr.{name}") for name in MODULES})
    except ImportError:
        modules = None
    if not hasattr(getattr(modules, "UsdVol", None), FIELD):
        hint = "pip install 'splatlift[formats]'"
        raise Unavailable("USD", expected="usd-core 26.3 or later", got="none", hint=hint)
    return modules


def usd_blocks(
    splats: Splats, document: Mapping[str, Any] | None = None, suffix: str = ".usdc", *, prims: bool = False
) -> Iterator[bytes]:
    """Yield the bytes of a USD file of any splats (`gaussian_rows`), with their extras and the labels' document.

    Args:
        splats: P. document: of `liftcore.io.labels`; None: splats without labels. suffix: .usdc, .usda or .usdz.
        prims: True: each object is a particle field of its own, ``/Scene/instance_N``, and splats of none are
            ``/Scene/Splats``; False: all are one field, and an object is a subset.

    Raises:
        InvalidSplats: the format cannot store the columns, or ``prims`` is set without ``instance_id``.
        Unavailable: usd-core is not installed.
    """
    pxr, columns = open_library(), stored_columns(splats)
    if prims and IDS[0] not in columns:
        hint = "export labels, such as the objects of a lift"
        raise InvalidSplats("prims", expected=f"a column {IDS[0]}", got="splats without it", hint=hint)
    with scratch_folder("splatlift-") as folder:
        path = folder / f"scene{'.usdc' if suffix == '.usdz' else suffix}"
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
        instance_rows = rows_by_id(dict(document or {}), KINDS[0])
        if prims:
            for number, rows in _instances(columns[IDS[0]]):
                prim_columns = {name: column[rows] for name, column in columns.items()} | {ROW: rows.astype("i4")}
                prim = _write_field(stage, f"instance_{number}" if number else "Splats", splats[rows], prim_columns)
                _name(prim, instance_rows, number)
        else:
            prim = _write_field(stage, "Splats", splats, columns)
            for number, rows in _instances(columns[IDS[0]]) if IDS[0] in columns else ():
                if number:
                    _write_subset(stage, prim, instance_rows, number, rows)
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
    rows = list(gaussian_rows(splats))

    def concatenate(name: str) -> np.ndarray:
        return np.concatenate([getattr(block, name) for block in rows])

    means, colours = (concatenate("means") @ TO_FILE).astype("f4"), concatenate("colours")
    sh = (
        constant_terms(colours)[:, None] if splats.sh is None else splats.sh.cpu().numpy()[:, : (MAX_DEGREE + 1) ** 2]
    )
    rotated = np.concatenate(
        [
            np.einsum("ij,njc->nic", band_rotation(band, TO_FILE), sh[:, band**2 : (band + 1) ** 2])
            for band in range(round(sh.shape[1] ** 0.5))
        ],
        axis=1,
    )
    quats = np.roll(concatenate("quats") @ product_matrix(TO_FILE).T, -1, axis=1)  # in memory the real part is last
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/Scene/{name}")

    def vectors(values: np.ndarray) -> Any:
        return pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, "f4"))

    field.CreatePositionsAttr(vectors(means))
    field.CreateScalesAttr(vectors(concatenate("scales")))
    field.CreateOrientationsAttr(pxr.Vt.QuatfArray.FromNumpy(np.ascontiguousarray(quats, "f4")))
    field.CreateOpacitiesAttr(pxr.Vt.FloatArray.FromNumpy(concatenate("opacities").astype("f4")))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(round(sh.shape[1] ** 0.5) - 1)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(vectors(rotated.reshape(-1, 3)))
    field.CreateSortingModeHintAttr("cameraDistance")
    reach = 3 * concatenate("scales").max(axis=1, keepdims=True)
    low, high = (means - reach).min(axis=0).tolist(), (means + reach).max(axis=0).tolist()
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


def _write_subset(
    stage: Any, field: Any, instance_rows: Sequence[Mapping[str, Any]], number: int, rows: np.ndarray
) -> None:
    pxr = open_library()
    subset = pxr.UsdGeom.Subset.Define(stage, field.GetPath().AppendChild(f"instance_{number}"))
    subset.CreateElementTypeAttr(pxr.UsdGeom.Tokens.point)
    subset.CreateIndicesAttr(pxr.Vt.IntArray.FromNumpy(rows.astype("i4")))
    _name(subset.GetPrim(), instance_rows, number)


def _name(prim: Any, instance_rows: Sequence[Mapping[str, Any]], number: int) -> None:
    """Give a prim the semantic label of an instance, if it has a name."""
    if number and number < len(instance_rows) and (name := instance_rows[number].get("name")) is not None:
        open_library().UsdSemantics.LabelsAPI.Apply(prim, "class").CreateLabelsAttr([name])


def read_usd(path: Path, *, colour: bool = True) -> Fields:
    """Read the fields of all particle fields of a stage, in its order, in the frame of PLYs and cameras.

    Subsets of points come as ``instance_id``, where no primvar has that name.

    Raises:
        InvalidSplats: it does not open, has no splats, or a transform is no similarity.
        Unavailable: usd-core is not installed.
    """
    stage = _stage(path)
    prims = _fields(stage, path)
    fields = joined_fields([_field(prim, stage, path, colour=colour) for prim in prims])
    order = _row_order(prims, len(fields["means"]))
    if order is not None:
        extras = {name: column[order] for name, column in fields["extras"].items()}
        fields = {name: value[order] if isinstance(value, np.ndarray) else value for name, value in fields.items()}
        fields["extras"] = extras
    return fields | {"world": _world(stage)}


def _row_order(prims: Sequence[Any], count: int) -> np.ndarray | None:
    """Return the order [P] that restores rows split into prims; None if it is unknown or rows are missing."""
    stored_rows = [
        prim.GetAttribute(f"primvars:{ROW}").Get() if prim.HasAttribute(f"primvars:{ROW}") else None for prim in prims
    ]
    rows = np.concatenate([np.array([] if values is None else values, np.int64) for values in stored_rows])
    return np.argsort(rows) if len(rows) == count and len(np.unique(rows)) == count else None


def read_usd_document(path: Path) -> dict[str, Any]:
    """Read the document of a stage's labels: ours, else the names of its subsets."""
    pxr = open_library()
    stage = _stage(path)
    prim = _fields(stage, path)[0]
    text = prim.GetCustomDataByKey(DOCUMENT)
    if isinstance(text, str):
        try:
            document = json.loads(text)
        except (ValueError, RecursionError):
            document = None
        if isinstance(document, dict):
            return document
    rows = []
    for number, subset in enumerate(pxr.UsdGeom.Subset.GetAllGeomSubsets(pxr.UsdGeom.Imageable(prim)), 1):
        labels = pxr.UsdSemantics.LabelsAPI(subset.GetPrim(), "class").GetLabelsAttr().Get()
        rows.append({"instance_id": number, "name": str(labels[0]) if labels else subset.GetPrim().GetName()})
    return {"instances": rows} if rows else {}


def _stage(path: Path) -> Any:
    pxr = open_library()
    try:
        return pxr.Usd.Stage.Open(str(path))
    except pxr.Tf.ErrorException:
        got = "one that does not open"
        raise InvalidSplats(str(path), expected="a USD scene", got=got, hint=HINT) from None


def _world(stage: Any) -> WorldFrame:
    """Read our custom data of the layer, else the stage's metadata, in the frame of PLYs."""
    pxr, text = open_library(), (stage.GetMetadata("customLayerData") or {}).get(WORLD)
    if isinstance(text, str):
        try:
            return world_of(json.loads(text))
        except (ValueError, RecursionError):
            return UNKNOWN
    values = {"up": UPRIGHT.up} if stage.HasAuthoredMetadata("upAxis") else {}
    if pxr.UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        values["metres_per_unit"] = pxr.UsdGeom.GetStageMetersPerUnit(stage)
    return world_of(values)


def _fields(stage: Any, path: Path) -> list[Any]:
    prims = [prim for prim in stage.Traverse() if prim.GetTypeName() == FIELD]
    if not prims:
        raise InvalidSplats(str(path), expected=f"splats ({FIELD})", got="a scene without any", hint=HINT)
    return prims


def _field(prim: Any, stage: Any, path: Path, *, colour: bool) -> Fields:
    pxr = open_library()
    matrix = np.array(pxr.UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(pxr.Usd.TimeCode.Default())).T
    if pxr.UsdGeom.GetStageUpAxis(stage) == pxr.UsdGeom.Tokens.z:
        matrix[:3] = Z_UP @ matrix[:3]
    matrix = np.linalg.inv(_world(stage).placement(TO_FILE, in_metres=False)) @ matrix
    try:
        move = Similarity.of(matrix)
    except InvalidInput as error:
        argument, hint = f"{path} transform of {prim.GetPath()}", "apply the transform to the splats"
        raise InvalidSplats(argument, expected=error.expected, got=error.got, hint=hint) from None
    places = _array(prim, "positions", path).reshape(-1, 3).astype(np.float64)
    count, turn = len(places), TO_FILE @ move.rotation

    def read(name: str, width: int) -> np.ndarray:
        values = _array(prim, name, path)
        if values.size != count * width:
            expected = f"{count} rows of {width} numbers"
            raise InvalidSplats(f"{path} {name}", expected=expected, got=f"{values.size} numbers", hint=HINT)
        return values.reshape(count, width)

    quats = np.roll(read("orientations", 4).astype(np.float64), 1, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scales = np.log(read("scales", 3).astype(np.float64)) + np.log(move.scale)
    fields: Fields = {
        "means": places @ (move.scale * turn).T + TO_FILE @ move.translation,
        "quats": (quats @ product_matrix(turn).T).astype(np.float32),
        "log_scales": scales.astype(np.float32),
        "opacity_logits": logits(read("opacities", 1)[:, 0]).astype(np.float32),
        "extras": {},
    }
    if not colour:
        return fields
    coefficients = "radiance:sphericalHarmonicsCoefficients"
    if not any(prim.GetAttribute(name).HasAuthoredValue() for name in (coefficients, f"{coefficients}h")):
        return fields | {"extras": _extras(prim, count)}
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    if not isinstance(degree, int) or not 0 <= degree <= MOST_DEGREE:
        expected = f"harmonics of a degree from 0 to {MOST_DEGREE}"
        raise InvalidSplats(f"{path} {prim.GetPath()}", expected=expected, got=repr(degree)[:40], hint=HINT)
    rows = (degree + 1) ** 2
    terms = read(coefficients, 3 * rows).reshape(count, rows, 3).astype(np.float32)
    for band in range(degree + 1):
        band_rows = slice(band**2, (band + 1) ** 2)
        terms[:, band_rows] = np.einsum("ij,njc->nic", band_rotation(band, turn), terms[:, band_rows])
    return fields | {"sh": terms, "extras": _extras(prim, count)}


def _array(prim: Any, name: str, path: Path) -> np.ndarray:
    """Read an attribute, or its half-precision variant, as an array."""
    for attribute in (name, f"{name}h"):
        values = prim.GetAttribute(attribute).Get()
        if values is not None and len(values):
            return np.array(values)
    raise InvalidSplats(f"{path} {prim.GetPath()}", expected=f"values of {name}", got="none", hint=HINT)


def _extras(prim: Any, count: int) -> dict[str, np.ndarray]:
    pxr = open_library()
    extras: dict[str, np.ndarray] = {}
    for primvar in pxr.UsdGeom.PrimvarsAPI(prim).GetPrimvars():
        name, values = str(primvar.GetPrimvarName()), primvar.Get()
        if name == ROW or not COLUMN.fullmatch(name) or MODEL.fullmatch(name) or values is None:
            continue
        column = np.array(values)
        if column.shape == (count,) and column.dtype.kind in "iuf":
            kind = np.float32 if column.dtype.kind == "f" else np.int32
            extras[name] = id_column(column) if name in IDS else column.astype(kind)
    subsets = pxr.UsdGeom.Subset.GetAllGeomSubsets(pxr.UsdGeom.Imageable(prim))
    if subsets and IDS[0] not in extras:
        numbers = np.zeros(count, np.int32)
        for number, subset in enumerate(subsets, 1):
            rows = np.array(subset.GetIndicesAttr().Get() or [], int)
            numbers[rows[(rows >= 0) & (rows < count)]] = number
        extras[IDS[0]] = numbers
    return extras
