"""Who may ask the panel for anything: who has its token, from a page of its own, under a name of this machine."""

from __future__ import annotations

import hmac
from collections.abc import Sequence
from urllib.parse import urlsplit

HOSTS = frozenset({"127.0.0.1", "localhost", "::1"})
"""Names of the loopback. A page of elsewhere whose name is made to lead here (DNS rebinding) comes with another."""


def refused(token: str, path: str, hosts: Sequence[str], origins: Sequence[str]) -> str | None:
    """Return why a request is refused, None where it is not.

    `path` is what was asked for, /TOKEN/FILE; `hosts` and `origins` are the values of all headers of these names. A
    browser sends the origin with whatever a script asks for: it must be the page's own.
    """
    try:
        (host,) = hosts
        hostname = urlsplit(f"http://{host}").hostname
    except ValueError:
        hostname = None
    if hostname not in HOSTS:
        return "this page is for this machine alone: open it as 127.0.0.1 or localhost, from afar through ssh -L"
    if any(origin != f"http://{host}" for origin in origins):
        return "asked by a page of another origin"
    given = path.removeprefix("/").partition("/")[0]
    if not hmac.compare_digest(given.encode(), token.encode()):
        return "no such page: open the address that trirail panel has printed, with its token"
    return None
