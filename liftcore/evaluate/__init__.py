"""Public: what users run on their files and scenes.

- ``inspect_file``: the content of a file; ``check_scene``: a check that files belong together
- ``compare_speeds`` of `SceneFiles`: accuracy against speed on a scene
- ``evaluate_lift``: the accuracy of a lift by masks of phrases in its views
"""

from liftcore.runtime.lazy_names import lazy_names

__getattr__, __dir__ = lazy_names(__name__, __file__)
