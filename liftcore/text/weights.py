"""Weights of encoders by name, from the cache of their library or else from the network, in one attempt.

The libraries themselves contact the network first and retry for most of a minute if there is none.
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
SECONDS = 5.0  # timeout of the first response
EXPECTED = "weights in the cache or a network to fetch them"

log = logging.getLogger(__name__)


def fetch_weights(label: str, load: Callable[[], T], hint: str) -> T:
    """Call ``load``, which reads weights of the Hugging Face Hub, and return its result. A download is logged."""
    from huggingface_hub import constants

    with _cache_alone(), suppress(Exception):  # each library raises its own types
        return load()
    host = urlsplit(constants.ENDPOINT).netloc
    if constants.HF_HUB_OFFLINE:
        raise Unavailable(label, expected=EXPECTED, got="none, and HF_HUB_OFFLINE is set", hint=hint)
    if not _is_reachable(constants.ENDPOINT):
        got = f"neither: {host} did not respond within {SECONDS:g} s"
        raise Unavailable(label, expected=EXPECTED, got=got, hint=hint)
    log.warning("%s: downloading weights from %s", label, host)
    try:
        return load()
    except Exception as error:  # clients of the hub raise their own types, those of urllib and OSErrors
        got = " ".join(str(error).split())
        raise Unavailable(label, expected=EXPECTED, got=got[:200], hint=hint) from None


@contextmanager
def _cache_alone() -> Iterator[None]:
    """Make the hub's client refuse every request at once, so that only its cache is read."""
    from huggingface_hub import constants

    before = constants.HF_HUB_OFFLINE
    constants.HF_HUB_OFFLINE = True
    try:
        yield
    finally:
        constants.HF_HUB_OFFLINE = before


def _is_reachable(url: str) -> bool:
    """Return True if the host responds in time. A thread waits for it, as name resolution has no timeout."""
    answers: list[bool] = []

    def request_head() -> None:
        with suppress(OSError, ValueError):
            with suppress(urllib.error.HTTPError):  # an error status is a response too
                urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=SECONDS).close()
            answers.append(True)

    thread = threading.Thread(target=request_head, daemon=True)
    thread.start()
    thread.join(SECONDS)
    return bool(answers)
