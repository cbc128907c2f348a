"""Which requests may connect: host, origin, token."""

from __future__ import annotations

import ipaddress
import secrets
from collections.abc import Collection
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

COOKIE = "presage_token"


def same_origin(origin: str | None, host: str | None) -> bool:
    """Whether a socket is asked for by a page of this very server. Browsers always say whose page it is."""
    if not origin or not host:
        return False
    try:
        parts = urlsplit(origin)
        port = parts.port
    except ValueError:
        return False
    default = {"http": 80, "https": 443}.get(parts.scheme)
    if default is None:
        return False
    return (parts.hostname, port or default) == split_host(host, default)


def split_host(host: str, default: int) -> tuple[str | None, int]:
    """Name, in small letters and without brackets, and port of a Host header; no name where it is none."""
    try:
        parts = urlsplit(f"//{host}")
        name, port = parts.hostname, parts.port or default
    except ValueError:
        return None, 0
    return (name, port) if parts.netloc == host and "@" not in host else (None, 0)


def known_host(host: str | None, names: Collection[str]) -> bool:
    """Whether the page was asked for under an address, or a name that is surely this machine's.

    A page of another host that makes its own name point here (DNS rebinding) has the same origin as it; its name
    gives it away.
    """
    name = split_host(host, 80)[0] if host else None
    if name is None:
        return False
    if name == "localhost" or name.endswith(".localhost") or name in names:
        return True
    try:
        ipaddress.ip_address(name.split("%")[0])
    except ValueError:
        return False
    return True


def token_of(cookie: str | None, query: str) -> str:
    """The token a visitor brings: of the address first, then of the cookie; empty where there is none."""
    given = parse_qs(query).get("token")
    if given:
        return given[0]
    try:
        morsel = SimpleCookie(cookie or "").get(COOKIE)
    except CookieError:
        return ""
    return morsel.value if morsel is not None else ""


def is_token(given: str, token: str) -> bool:
    """Whether it is the one; takes as long for each wrong one."""
    return secrets.compare_digest(given.encode(), token.encode())
