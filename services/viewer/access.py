"""Decides which requests may connect, by host, origin and token."""

from __future__ import annotations

import ipaddress
import secrets
from collections.abc import Collection
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

COOKIE = "presage_token"


def same_origin(origin: str | None, host: str | None) -> bool:
    """Whether a web socket is requested by a page of this server. Browsers always send the page's origin."""
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
    """Name (lower case, without brackets) and port of a Host header. The name is None if the header is invalid."""
    try:
        parts = urlsplit(f"//{host}")
        name, port = parts.hostname, parts.port or default
    except ValueError:
        return None, 0
    return (name, port) if parts.netloc == host and "@" not in host else (None, 0)


def known_host(host: str | None, names: Collection[str]) -> bool:
    """Whether the Host header is an IP address, localhost or one of ``names``.

    This guards against DNS rebinding: a page of another host whose name resolves to this machine passes the check of
    the origin, but sends its own name as the host.
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
    """The visitor's token, from the query string or else from the cookie; empty if there is none."""
    given = parse_qs(query).get("token")
    if given:
        return given[0]
    try:
        morsel = SimpleCookie(cookie or "").get(COOKIE)
    except CookieError:
        return ""
    return morsel.value if morsel is not None else ""


def is_token(given: str, token: str) -> bool:
    """Compares tokens in constant time."""
    return secrets.compare_digest(given.encode(), token.encode())
