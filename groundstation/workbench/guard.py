"""Who may ask the page anything: whoever has the link that the terminal printed, from this machine.

A page of the internet that the same browser shows may try to speak to us: under a name of its own that points to this
machine (DNS rebinding), which `Host` gives away, or from its own pages, which `Origin` and the cookie's SameSite give
away.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

SAFE = ("GET", "HEAD")
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; worker-src 'self' blob:; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Guard:
    """Lets through what comes with the cookie; `hosts` are the names under which the page is served, with their port.

    The link's token is good for one browser: it becomes the cookie, and the next link is told by `renewed`.
    """

    def __init__(
        self, app: ASGIApp, hosts: frozenset[str], secure: bool, renewed: Callable[[str], None]
    ) -> None:
        self._app = app
        self._hosts = hosts
        self._scheme = "https" if secure else "http"
        self._secret = secrets.token_urlsafe(32)
        self._renewed = renewed
        port = next(iter(hosts)).rpartition(":")[2]
        self._cookie = f"trueflight-{port}"  # cookies know no ports: two pages of one machine share them
        self.token = secrets.token_urlsafe(32)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return
        answer = self._answer(scope)
        if answer is not None:
            answer.headers.update(HEADERS)
            await answer(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    given.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, with_headers)

    def _answer(self, scope: Scope) -> Response | None:
        """The answer to what is not let through, or to the link; None for what is let through."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if host not in self._hosts:
            return _refused(421, f"this page is not served as '{host[:80]}'")
        if scope["method"] not in SAFE and headers.get("origin") not in {
            f"{self._scheme}://{h}" for h in self._hosts
        }:
            return _refused(403, "this was asked by another page")
        if headers.get("sec-fetch-site") == "cross-site" and scope["path"] != "/":
            return _refused(403, "this was asked by another page")
        known = self._known(headers)
        token = QueryParams(scope["query_string"]).get("token")
        if scope["path"] == "/" and token is not None and scope["method"] == "GET":
            if known:
                return RedirectResponse("/", 303)
            if secrets.compare_digest(token.encode(), self.token.encode()):
                self.token = secrets.token_urlsafe(32)
                self._renewed(self.token)
                return self._admitted()
        if not known:
            return _refused(
                403,
                "open the link that the terminal shows; a link is good for one browser, the next stands there",
            )
        return None

    def _admitted(self) -> Response:
        answer = RedirectResponse("/", 303)
        answer.set_cookie(
            self._cookie,
            self._secret,
            httponly=True,
            samesite="strict",
            secure=self._scheme == "https",
            path="/",
        )
        return answer

    def _known(self, headers: Headers) -> bool:
        jar: SimpleCookie = SimpleCookie()
        try:
            jar.load(headers.get("cookie", ""))
        except CookieError:
            return False
        given = jar[self._cookie].value if self._cookie in jar else ""
        return secrets.compare_digest(given.encode(), self._secret.encode())


def _refused(status: int, why: str) -> Response:
    return PlainTextResponse(f"refused: {why}\n", status)
