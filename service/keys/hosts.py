"""Which names the service answers to, and which web pages may ask it to do something.

The threat is a page of another site in the browser of somebody who can reach the service. It may send requests
itself (then its Origin tells), or have its own name point to this machine (DNS rebinding; then the Host tells).
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from urllib.parse import urlsplit

from starlette.datastructures import Headers

from service.errors import ForeignOrigin, Misdirected
from service.keys.scopes import SAFE

LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})


class Hosts:
    """The names of this service.

    Args:
        bound: the address that the service listens on. When that is all of them, every address in digits is this
            service: rebinding needs a name.
        allowed: more names, for those who come through a proxy or by a name of this machine.
    """

    def __init__(self, bound: str, allowed: Iterable[str]) -> None:
        self._allowed = frozenset(name.lower() for name in allowed)
        self._names = LOOPBACK | {bound.lower()} | self._allowed
        self._all_addresses = _is_address(bound) and ipaddress.ip_address(bound).is_unspecified

    def check(self, method: str, headers: Headers) -> None:
        """See that a request means this service, and that no foreign page sends it.

        Raises:
            Misdirected: the Host is another.
            ForeignOrigin: it would change something, and comes from a page of another site.
        """
        hosts = headers.getlist("host")
        name = host_name(hosts[0]) if len(hosts) == 1 else None
        if name is None or not (name in self._names or (self._all_addresses and _is_address(name))):
            raise Misdirected(
                "Host", expected="a name of this service", got=", ".join(hosts)[:200] or "none",
                hint="the operator may add names with SPLATLIFT_ALLOWED_HOSTS",
            )  # fmt: skip
        origins = headers.getlist("origin")
        if method not in SAFE and any(not self._same_site(origin, hosts[0]) for origin in origins):
            raise ForeignOrigin("Origin", expected="this service's own page", got=", ".join(origins)[:200])

    def _same_site(self, origin: str, host: str) -> bool:
        try:
            authority = urlsplit(origin).netloc.lower()
        except ValueError:
            return False
        return authority != "" and (authority == host.lower() or host_name(authority) in self._allowed)


def host_name(host: str) -> str | None:
    """The name in a Host header, lower case, without port and brackets; None when it is malformed."""
    name, bracket, rest = host.strip().lower().rpartition("]")
    if bracket:
        name = name.removeprefix("[")
        return name if _is_address(name) and _is_port(rest) else None
    name, colon, port = rest.partition(":")
    return name.removesuffix(".") if name and _is_port(colon + port) else None


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches that address."""
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def _is_port(text: str) -> bool:
    return text == "" or (text.startswith(":") and text[1:].isascii() and text[1:].isdigit())


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
