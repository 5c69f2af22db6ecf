"""Weights by name, for encoders: from the cache of the library that knows them, else from the network, tried once.

Libraries ask the network first and try again for most of a minute where there is none.
"""

import logging
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TypeVar
from urllib.parse import urlsplit

from liftcore.errors import Unavailable

T = TypeVar("T")
SECONDS = 5.0  # that the network has to answer
EXPECTED = "weights in the cache or a network to fetch them"

log = logging.getLogger(__name__)


def fetched(label: str, make: Callable[[], T], hint: str) -> T:
    """What ``make`` makes of weights of Hugging Face's hub; a line in the log says where they are fetched.

    Raises:
        Unavailable: they are not in the cache, and the network does not answer or does not have them.
    """
    from huggingface_hub import constants

    with _cache_alone(), suppress(Exception):  # each library raises its own kinds
        return make()
    host = urlsplit(constants.ENDPOINT).netloc
    if constants.HF_HUB_OFFLINE:
        raise Unavailable(label, expected=EXPECTED, got="none, and HF_HUB_OFFLINE is set", hint=hint)
    if not _answers(constants.ENDPOINT):
        got = f"neither: {host} does not answer within {SECONDS:g} s"
        raise Unavailable(label, expected=EXPECTED, got=got, hint=hint)
    log.warning("%s: fetching its weights from %s", label, host)
    try:
        return make()
    except Exception as error:  # the hub's clients raise their own, urllib's and OSError's kinds
        got = " ".join(str(error).split())
        raise Unavailable(label, expected=EXPECTED, got=got[:200], hint=hint) from None


@contextmanager
def _cache_alone() -> Iterator[None]:
    """No request of the hub's client leaves this machine: each is refused at once."""
    from huggingface_hub import constants

    before = constants.HF_HUB_OFFLINE
    constants.HF_HUB_OFFLINE = True
    try:
        yield
    finally:
        constants.HF_HUB_OFFLINE = before


def _answers(url: str) -> bool:
    """Whether anything answers there in time; a thread of its own, as no timeout holds for the look-up of names."""
    found: list[bool] = []

    def ask() -> None:
        with suppress(OSError, ValueError):
            with suppress(urllib.error.HTTPError):  # an answer like any other
                urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=SECONDS).close()
            found.append(True)

    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    asking.join(SECONDS)
    return bool(found)
