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

from functools import cache
from importlib import import_module
from typing import Any

from liftcore.runtime.version import __version__ as __version__


@cache
def _public() -> dict[str, str]:
    """The public names, each with the module that defines it, as ``__init__.pyi`` lists them."""
    import re  # with pathlib four milliseconds, which an import alone does without
    from pathlib import Path

    stub = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    return {name: module for module, name in re.findall(r"^from (\S+) import (\w+)", stub, re.MULTILINE)}


def __getattr__(name: str) -> Any:
    public = _public()
    if name == "__all__":
        value: Any = sorted(public.keys() - {"__version__"})
    elif name in public:
        value = getattr(import_module(public[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_public()})
