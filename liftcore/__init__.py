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

from liftcore.runtime.version import __version__ as __version__

if TYPE_CHECKING:
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
    from liftcore.io.cameras import read_cameras as read_cameras
    from liftcore.io.splats import read_splats as read_splats
    from liftcore.io.splats import write_splats as write_splats
    from liftcore.lifting.engines.base import LocalEngine as LocalEngine
    from liftcore.lifting.engines.ray import RayEngine as RayEngine
    from liftcore.lifting.operators import region_weights as region_weights
    from liftcore.lifting.operators import render as render
    from liftcore.lifting.pipeline import lift as lift
    from liftcore.lifting.pipeline import plan as plan
    from liftcore.lifting.planning.photos import PhotoPlan as PhotoPlan
    from liftcore.lifting.planning.photos import plan_photos as plan_photos
    from liftcore.lifting.planning.plan import Plan as Plan
    from liftcore.query.ask import VectorAnswer as VectorAnswer
    from liftcore.query.catalogue import Catalogue as Catalogue
    from liftcore.query.catalogue import SceneObject as SceneObject
    from liftcore.query.objects import FoundObject as FoundObject
    from liftcore.query.objects import Objects as Objects
    from liftcore.query.result import LiftResult as LiftResult
    from liftcore.query.result import load_lift as load_lift
    from liftcore.query.segment import NamedSplats as NamedSplats
    from liftcore.query.segment import Segmentation as Segmentation
    from liftcore.scene.cameras import Camera as Camera
    from liftcore.scene.cameras import Cameras as Cameras
    from liftcore.scene.compositing import CompositingParams as CompositingParams
    from liftcore.scene.splats import Splats as Splats
    from liftcore.text import TextEncoder as TextEncoder
    from liftcore.text import open_encoder as open_encoder
    from liftcore.values.pack import read_features as read_features
    from liftcore.values.region_weights import RegionWeights as RegionWeights
    from liftcore.values.settings import LiftSettings as LiftSettings
    from liftcore.values.views import FeatureGrid as FeatureGrid
    from liftcore.values.views import Regions as Regions


_PUBLIC = {  # name -> the module that defines it
    "read_splats": "liftcore.io.splats",
    "write_splats": "liftcore.io.splats",
    "read_cameras": "liftcore.io.cameras",
    "read_features": "liftcore.values.pack",
    "Splats": "liftcore.scene.splats",
    "Camera": "liftcore.scene.cameras",
    "Cameras": "liftcore.scene.cameras",
    "Regions": "liftcore.values.views",
    "FeatureGrid": "liftcore.values.views",
    "LiftSettings": "liftcore.values.settings",
    "lift": "liftcore.lifting.pipeline",
    "plan": "liftcore.lifting.pipeline",
    "Plan": "liftcore.lifting.planning.plan",
    "plan_photos": "liftcore.lifting.planning.photos",
    "PhotoPlan": "liftcore.lifting.planning.photos",
    "LocalEngine": "liftcore.lifting.engines.base",
    "RayEngine": "liftcore.lifting.engines.ray",
    "LiftResult": "liftcore.query.result",
    "load_lift": "liftcore.query.result",
    "open_encoder": "liftcore.text",
    "TextEncoder": "liftcore.text",
    "VectorAnswer": "liftcore.query.ask",
    "Segmentation": "liftcore.query.segment",
    "NamedSplats": "liftcore.query.segment",
    "Catalogue": "liftcore.query.catalogue",
    "SceneObject": "liftcore.query.catalogue",
    "Objects": "liftcore.query.objects",
    "FoundObject": "liftcore.query.objects",
    "region_weights": "liftcore.lifting.operators",
    "RegionWeights": "liftcore.values.region_weights",
    "render": "liftcore.lifting.operators",
    "CompositingParams": "liftcore.scene.compositing",
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
    "write_splats",
]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_PUBLIC[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
