"""Public: what questions and bodies of requests are made of, for programs that serve them. Loads no torch."""

from liftcore.query.question import METHODS, Found, Notation, OwnCamera, Seen
from liftcore.runtime.fields import Body, NoBoolean, takes

__all__ = ["METHODS", "Body", "Found", "NoBoolean", "Notation", "OwnCamera", "Seen", "takes"]
