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

What ``__init__.pyi`` lists is the public interface, with ``__all__`` of the modules `liftcore.errors`,
`liftcore.evaluate`, `liftcore.files`, `liftcore.models`, `liftcore.text` and `liftcore.text.table`; the command line
and the service import nothing else. Modules are loaded on first use: ``import liftcore`` loads no torch.
"""

from liftcore.runtime.lazy_names import lazy_names
from liftcore.runtime.version import __version__ as __version__

__getattr__, __dir__ = lazy_names(__name__, __file__)
