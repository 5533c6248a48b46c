"""Access to the server: by the token that the command prints, from a page of this server; to one file by a signed URL.

The token in the address is exchanged once for a cookie that no script can read. A cookie is sent to every port of a
host (RFC 6265 knows no ports), so its name carries the port: two servers do not overwrite each other's. `Host` has to
be a name of this machine or an allowed one: a foreign name that resolves to 127.0.0.1 (DNS rebinding) is refused.
`Origin`, where a browser sends it, has to be this server: a page of another port is of the same site, and its requests
carry the cookie.

rerun's viewer fetches its .rrd without cookies. The URL of that file is signed: it carries a time until which it is
valid, and an HMAC of time and file name by a key that is new with every start of the server.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
import time
from collections.abc import Iterable
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

from kinetix_dist.errors import one_line

TOKEN_BYTES = 24
# A browser with a window requests the icon of every page: the one that is linked, else /favicon.ico.
ICON = "static/icon.svg"
ICON_LINK = f'<link rel="icon" href="{ICON}" type="image/svg+xml" />'
ICON_PATHS = ("/favicon.ico", f"/{ICON}")  # open: a page without access has an icon too
ENTER_SCRIPT = "static/enter.js"  # open: takes what is behind the # of an address along to where the token leads
REFUSAL = "no access: open the address with its token that `kinetix-dist` printed"
REFUSAL_PAGE = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    f'<meta name="color-scheme" content="dark light"><title>kinetix-dist</title>{ICON_LINK}<p>{REFUSAL}</p>'
    '<p><label>or paste that address here <input id="address" type="text" autocomplete="off" autofocus></label> '
    '<button id="enter">go on</button></p><p id="problem" role="alert"></p>'
    f'<script src="{ENTER_SCRIPT}"></script></html>'
)
LOOPBACK_NAMES = {"localhost", "127.0.0.1", "::1"}

CONTENT_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "font-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
HEADERS = {
    "Content-Security-Policy": CONTENT_POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the token is never in one
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",  # requested again, and answered "not modified"
}


class Access:
    """Checks of requests, as the `middleware` of an aiohttp application."""

    def __init__(
        self,
        *,
        port: int,
        host: str,
        allowed_hosts: Iterable[str] = (),
        open_paths: Iterable[str] = (),
        first_page: str = "",
    ):
        """host: the one listened on; open_paths: prefixes of further paths that need no cookie, since their URLs are
        signed; first_page: "#/edit", where the address with the token leads."""
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        self.cookie_name = f"kinetix_dist_{port}"
        self._cookie = secrets.token_urlsafe(TOKEN_BYTES)
        self._allowed = {name.lower() for name in allowed_hosts}
        self._own_names = LOOPBACK_NAMES | {socket.gethostname().lower() if _is_any(host) else host.lower()}
        self._open_paths = (*ICON_PATHS, f"/{ENTER_SCRIPT}", *open_paths)
        self._first_page = first_page

    @property
    def middleware(self) -> Middleware:
        @web.middleware
        async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
            return await self._answer(request, handler)

        return check

    @staticmethod
    async def add_headers(request: web.Request, response: web.StreamResponse) -> None:
        """Handler of `on_response_prepare`: tells a browser what every response, errors too, may be used for."""
        for name, value in HEADERS.items():
            response.headers.setdefault(name, value)

    async def _answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        problem = self.refusal_of_origin(request.headers.get("Host"), request.headers.get("Origin"))
        if problem is not None:
            return web.Response(status=403, text=one_line(problem) + "\n")
        if "token" in request.query:
            return self._exchange(request)
        if not request.path.startswith(self._open_paths) and not self._has_cookie(request):
            if request.path == "/" and "text/html" in request.headers.get("Accept", ""):
                return web.Response(status=401, text=REFUSAL_PAGE, content_type="text/html")
            return web.Response(status=401, text=REFUSAL + "\n")
        return await handler(request)

    def refusal_of_origin(self, host: str | None, origin: str | None) -> str | None:
        """Reason in one line for which a request with these headers is refused; None: it is not."""
        name = _host_name(host)
        if name is None or not (name in self._own_names or name in self._allowed):
            return f"host {name or host!r} is not served; start with --allow-host {name or 'NAME'} if it is yours"
        if origin is None:
            return None
        netloc = urlsplit(origin).netloc
        if netloc.lower() != (host or "").lower() and _host_name(netloc) not in self._allowed:
            return f"origin {origin} is not this server"
        return None

    def _exchange(self, request: web.Request) -> web.Response:
        """Page that leads on to the address without the token, with the cookie.

        A redirect would carry no cookie of SameSite=Strict where a link of another site led here. A script leads on,
        with what is behind #; without scripts a refresh.
        """
        if request.method != "GET" or not hmac.compare_digest(request.query["token"].encode(), self.token.encode()):
            return web.Response(
                status=401, text="wrong token: it is new with every start; use the address that was printed last\n"
            )
        there = f"./{self._first_page}"
        refresh = f'<noscript><meta http-equiv="refresh" content="0;url={there}"></noscript>'
        script = f'<script src="{ENTER_SCRIPT}" data-there="{self._first_page}"></script>'
        response = web.Response(
            text=f'<!doctype html>{ICON_LINK}{refresh}{script}<a href="{there}">go on</a>', content_type="text/html"
        )
        response.set_cookie(self.cookie_name, self._cookie, httponly=True, samesite="Strict", path="/")
        return response

    def _has_cookie(self, request: web.Request) -> bool:
        found = request.cookies.get(self.cookie_name, "")
        return hmac.compare_digest(found.encode(), self._cookie.encode())


def is_loopback(host: str) -> bool:
    """True where only this machine can reach a server that listens on the host."""
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def _is_any(host: str) -> bool:
    return _is_address(host) and ipaddress.ip_address(host).is_unspecified


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _host_name(netloc: str | None) -> str | None:
    """Host without its port, in lower case; None for a missing or malformed one."""
    try:
        return urlsplit(f"//{netloc}").hostname if netloc else None
    except ValueError:
        return None


VALID_SECONDS = 600.0


class UrlSigner:
    """Signatures of URLs of single files, for requests that carry no cookie."""

    def __init__(self) -> None:
        self._key = secrets.token_bytes(32)

    def sign(self, name: str, now: float | None = None) -> str:
        """Signature for a file name, valid for VALID_SECONDS from now (unix time s) on."""
        until = int((time.time() if now is None else now) + VALID_SECONDS)
        return f"{until}-{self._code(name, until)}"

    def is_valid(self, signature: str, name: str, now: float | None = None) -> bool:
        """True for a signature of ours, for this name, that has not expired."""
        until, _, code = signature.partition("-")
        if not (until.isascii() and until.isdigit() and len(until) < 16):
            return False
        is_ours = hmac.compare_digest(code.encode(), self._code(name, int(until)).encode())
        return is_ours and (time.time() if now is None else now) < int(until)

    def _code(self, name: str, until: int) -> str:
        return hmac.new(self._key, f"{until} {name}".encode(), "sha256").hexdigest()
