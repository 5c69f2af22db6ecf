"""Public: kinds of files, and checks of their paths, for programs that receive files. Loads no torch.

``identify`` names the kind of a file, ``wrong_kind`` is the error for one in the place of another, ``check_output``
looks at a path before the work that is to be written there.
"""

from liftcore.runtime.lazy_names import lazy_names

__getattr__, __dir__ = lazy_names(__name__, __file__)
