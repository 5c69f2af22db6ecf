"""splatlift: image features onto trained Gaussian splats, in closed form.

Lifting solves ``A X = B``: ``A`` [rays x splats] holds the alpha-compositing weights of a trained splat
scene, ``B`` [rays x channels] the 2D features of its photos, ``X`` [splats x channels] the lifted features
(*Splat Feature Solver*, Eq. 3)::

    import liftcore as lc

    splats = lc.read_splats("scene.ply")  # or lc.Splats(...), of torch or numpy
    cameras = lc.read_cameras("sparse/0")  # or {"0001": lc.Camera(...)}
    views = lc.read_features("pack.safetensors")  # or {"0001": lc.FeatureGrid(map)}, or an iterator of pairs
    result = lc.lift(splats, cameras, views)
    result.save("scene.lift.safetensors")

What is listed here is the public interface. It is loaded when it is asked for: ``import liftcore`` loads neither
torch nor numba.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from liftcore.engine.base import LocalEngine as LocalEngine
    from liftcore.engine.ray import RayEngine as RayEngine
    from liftcore.errors import InvalidCameras as InvalidCameras
    from liftcore.errors import InvalidFeatures as InvalidFeatures
    from liftcore.errors import InvalidInput as InvalidInput
    from liftcore.errors import InvalidLift as InvalidLift
    from liftcore.errors import InvalidQuery as InvalidQuery
    from liftcore.errors import InvalidSettings as InvalidSettings
    from liftcore.errors import InvalidSplats as InvalidSplats
    from liftcore.errors import NotFound as NotFound
    from liftcore.errors import SplatliftError as SplatliftError
    from liftcore.errors import Unavailable as Unavailable
    from liftcore.features.pack import read_features as read_features
    from liftcore.features.views import FeatureGrid as FeatureGrid
    from liftcore.features.views import Regions as Regions
    from liftcore.io.cameras import read_cameras as read_cameras
    from liftcore.io.lift_file import load_lift as load_lift
    from liftcore.io.splats import read_splats as read_splats
    from liftcore.lifting import lift as lift
    from liftcore.lifting import plan as plan
    from liftcore.operators import region_weights as region_weights
    from liftcore.operators import render as render
    from liftcore.planning.photos import PhotoPlan as PhotoPlan
    from liftcore.planning.photos import plan_photos as plan_photos
    from liftcore.planning.plan import Plan as Plan
    from liftcore.query.ask import VectorAnswer as VectorAnswer
    from liftcore.query.catalogue import Catalogue as Catalogue
    from liftcore.query.catalogue import SceneObject as SceneObject
    from liftcore.query.objects import FoundObject as FoundObject
    from liftcore.query.objects import Objects as Objects
    from liftcore.query.segment import NamedSplats as NamedSplats
    from liftcore.query.segment import Segmentation as Segmentation
    from liftcore.query.text import TextEncoder as TextEncoder
    from liftcore.query.text import open_encoder as open_encoder
    from liftcore.raster.base import CompositingParams as CompositingParams
    from liftcore.result import LiftResult as LiftResult
    from liftcore.scene.cameras import Camera as Camera
    from liftcore.scene.cameras import Cameras as Cameras
    from liftcore.scene.splats import Splats as Splats
    from liftcore.settings import LiftSettings as LiftSettings
    from liftcore.solve.weights import RegionWeights as RegionWeights

__version__ = "0.4.0"

_PUBLIC = {  # name -> the module that defines it
    "read_splats": "liftcore.io.splats",
    "read_cameras": "liftcore.io.cameras",
    "read_features": "liftcore.features.pack",
    "Splats": "liftcore.scene.splats",
    "Camera": "liftcore.scene.cameras",
    "Cameras": "liftcore.scene.cameras",
    "Regions": "liftcore.features.views",
    "FeatureGrid": "liftcore.features.views",
    "LiftSettings": "liftcore.settings",
    "lift": "liftcore.lifting",
    "plan": "liftcore.lifting",
    "Plan": "liftcore.planning.plan",
    "plan_photos": "liftcore.planning.photos",
    "PhotoPlan": "liftcore.planning.photos",
    "LocalEngine": "liftcore.engine.base",
    "RayEngine": "liftcore.engine.ray",
    "LiftResult": "liftcore.result",
    "load_lift": "liftcore.io.lift_file",
    "open_encoder": "liftcore.query.text",
    "TextEncoder": "liftcore.query.text",
    "VectorAnswer": "liftcore.query.ask",
    "Segmentation": "liftcore.query.segment",
    "NamedSplats": "liftcore.query.segment",
    "Catalogue": "liftcore.query.catalogue",
    "SceneObject": "liftcore.query.catalogue",
    "Objects": "liftcore.query.objects",
    "FoundObject": "liftcore.query.objects",
    "region_weights": "liftcore.operators",
    "RegionWeights": "liftcore.solve.weights",
    "render": "liftcore.operators",
    "CompositingParams": "liftcore.raster.base",
    "SplatliftError": "liftcore.errors",
    "InvalidInput": "liftcore.errors",
    "InvalidSplats": "liftcore.errors",
    "InvalidCameras": "liftcore.errors",
    "InvalidFeatures": "liftcore.errors",
    "InvalidLift": "liftcore.errors",
    "InvalidSettings": "liftcore.errors",
    "InvalidQuery": "liftcore.errors",
    "NotFound": "liftcore.errors",
    "Unavailable": "liftcore.errors",
}

__all__ = [
    "Camera",
    "Cameras",
    "Catalogue",
    "CompositingParams",
    "FeatureGrid",
    "FoundObject",
    "InvalidCameras",
    "InvalidFeatures",
    "InvalidInput",
    "InvalidLift",
    "InvalidQuery",
    "InvalidSettings",
    "InvalidSplats",
    "LiftResult",
    "LiftSettings",
    "LocalEngine",
    "NamedSplats",
    "NotFound",
    "Objects",
    "PhotoPlan",
    "Plan",
    "RayEngine",
    "RegionWeights",
    "Regions",
    "SceneObject",
    "Segmentation",
    "SplatliftError",
    "Splats",
    "TextEncoder",
    "Unavailable",
    "VectorAnswer",
    "lift",
    "load_lift",
    "open_encoder",
    "plan",
    "plan_photos",
    "read_cameras",
    "read_features",
    "read_splats",
    "region_weights",
    "render",
]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_PUBLIC[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
