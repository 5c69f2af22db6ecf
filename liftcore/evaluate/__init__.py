"""Public: what users run on their files and scenes.

- ``inspect_file``: what is in a file; ``check_scene``: whether files belong together
- ``run_bench``: how fast this machine lifts; ``compare_speeds`` of `SceneFiles`: what speed costs on a scene
- ``evaluate_lifts``: how near lifts come to the labels of LeRF-OVS and 3D-OVS
"""

from liftcore.runtime.lazy_names import lazy_names

__getattr__, __dir__ = lazy_names(__name__, __file__)
