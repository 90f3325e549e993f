"""Access control of the viewer: the Host header, an access token and the origin of a request."""

from __future__ import annotations

import contextlib
import hmac
import http
import ipaddress
import secrets
import socket
from collections.abc import Awaitable, Callable, Iterator, Mapping
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from mitsuba_irrcache.errors import IrrcacheError, reason

LOCAL = ("localhost", "127.0.0.1", "::1")


class Access:
    """Decide which requests a server that listens on ``host`` answers.

    Every request must address this machine by an IP address or by one of its own names; this
    rejects pages of other sites whose name was made to resolve to this machine (DNS rebinding).
    Where other machines can connect, each request also needs the ``token``: either in the query of
    the page's address, or in the cookie with which the server answers such a request.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        self.token = "" if is_local(host) else secrets.token_urlsafe(24)

    def refusal(self, path: str, headers: Mapping[str, str]) -> str:
        """Return the reason for which a request is refused, or "" if it is accepted."""
        if not self.is_own_host(headers.get("Host", "")):
            return "The viewer does not answer to this host name. Use the address that it printed."
        if self.token and not (self._has_token(path) or self._has_cookie(headers)):
            return "The token is missing. Use the whole address that irrcache view printed."
        return ""

    def is_own_host(self, asked: str) -> bool:
        """Return whether the value of a Host header names this machine.

        Accepted are IP addresses, which DNS rebinding cannot change, and the names of this machine;
        if only this machine can connect, its local names alone.
        """
        name = _host_name(asked)
        if is_local(self.host):
            return name in LOCAL
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name)
            return True
        own = {"localhost", self.host, socket.gethostname(), socket.getfqdn()}
        return name in {o.lower() for o in own}

    def query(self) -> str:
        """Return the query to append to the address of the page; it holds the token."""
        return f"?token={self.token}" if self.token else ""

    def cookie(self, path: str) -> str:
        """Return the Set-Cookie header for a request that carries the token, and "" for others."""
        if not (self.token and self._has_token(path)):
            return ""
        return f"{self._cookie_name}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    @property
    def _cookie_name(self) -> str:
        """Return a cookie name that is unique to this viewer.

        Browsers send cookies to all ports of a host, hence also to other viewers.
        """
        return f"irrcache_{self.token[:8]}"

    def _has_token(self, path: str) -> bool:
        given = parse_qs(urlsplit(path).query).get("token", [""])
        return self._is_token(given[0])

    def _has_cookie(self, headers: Mapping[str, str]) -> bool:
        try:
            cookies = SimpleCookie(headers.get("Cookie", ""))
        except CookieError:
            return False
        found = cookies.get(self._cookie_name)
        return found is not None and self._is_token(found.value)

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self.token.encode())


#: Answers a request by a response, or by None to leave it to viser.
Pages = Callable[[Request], Response | None]
#: Serves a websocket.
Handler = Callable[[object], Awaitable[None]]


@contextlib.contextmanager
def guarded(access: Access, pages: Pages, handlers: Mapping[str, Handler]) -> Iterator[None]:
    """Check every request to viser servers that are created within this context.

    Requests that pass are answered by ``pages``, and websockets are served by the one of the
    ``handlers`` that belongs to their path; all others are left to viser. Viser offers no hook for
    requests, so the function with which it starts its web server is replaced in the meantime.
    """
    serve = websockets.asyncio.server.serve

    def guarded_serve(
        handler: Handler, *args: object, process_request: Callable, **kwargs: object
    ) -> object:
        def checked(connection: object, request: Request) -> Response | None:
            why = access.refusal(request.path, request.headers)
            if why:
                return _text(http.HTTPStatus.FORBIDDEN, why)
            response = pages(request) or process_request(connection, request)
            cookie = access.cookie(request.path)
            if response is not None and cookie:
                response.headers["Set-Cookie"] = cookie
                response.headers["Referrer-Policy"] = "no-referrer"
                response.headers["Cache-Control"] = "no-store"
            return response

        async def chosen(connection: object) -> None:
            path = urlsplit(connection.request.path).path
            await handlers.get(path, handler)(connection)

        return serve(chosen, *args, process_request=checked, **kwargs)

    websockets.asyncio.server.serve = guarded_serve
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve


def is_own_page(headers: Mapping[str, str], access: Access) -> bool:
    """Return whether a browser sent the request from a page that this server delivered.

    The origin of such a request equals the host that it addresses, which is this machine. Programs
    that are not browsers send no origin.
    """
    origin = headers.get("Origin")
    if origin is None:
        return True
    asked, own = headers.get("Host", ""), urlsplit(origin)
    return (own.scheme, own.netloc) == ("http", asked) and access.is_own_host(asked)


def is_local(host: str) -> bool:
    """Return whether only this machine can connect to ``host``."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def is_wildcard(host: str) -> bool:
    """Return whether ``host`` stands for all addresses of this machine."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_unspecified
    return False


def check_host(host: str) -> None:
    """Raise IrrcacheError unless this machine can listen on ``host``.

    Viser itself would try one port after another without end.
    """
    try:
        if not host:
            raise OSError("it is empty")
        for family, kind, protocol, _, address in socket.getaddrinfo(
            host, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        ):
            with socket.socket(family, kind, protocol) as trial:
                trial.bind(address)
    except (OSError, UnicodeError) as error:
        raise IrrcacheError(
            f'--host is "{host}", where this machine cannot listen ({reason(error)}); give '
            "127.0.0.1 for this machine alone, 0.0.0.0 for all its networks, or one of its own "
            "addresses."
        ) from None


def _host_name(asked: str) -> str:
    """Return the name in a Host header in lower case without the port; "" if it is malformed."""
    try:
        return (urlsplit(f"//{asked}").hostname or "").rstrip(".")
    except ValueError:
        return ""


def _text(status: http.HTTPStatus, text: str) -> Response:
    body = f"{text}\n".encode()
    headers = Headers(
        {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
    )
    return Response(status.value, status.phrase, headers, body)
