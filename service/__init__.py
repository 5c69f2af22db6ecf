"""The HTTP service: thin routes over liftcore, a store and a job runner."""

import sys

from liftcore.errors import Unavailable

if sys.platform != "linux":
    _hint = "run it in a container (docker/), on Windows also in WSL; liftcore and the other commands run here"
    raise Unavailable("the service", expected="Linux", got=sys.platform, hint=_hint)
