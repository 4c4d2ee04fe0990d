"""Who may connect: this machine alone, with the token of this start.

The server listens on 127.0.0.1. Other programs and web pages on the same machine could still reach
it, so every request needs a cookie that only the link with the token sets, must name this machine
as its host (against names that are bound to it later), and must not come from a page of another
origin. Pages may load nothing from elsewhere.
"""

import secrets

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

_HEADERS = {
    "content-security-policy": (
        "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
        "style-src 'self' 'unsafe-inline'; frame-ancestors 'self'; form-action 'self'"
    ),
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}


class Guard:
    """Refuses what does not come from the person who started the application.

    Args:
        application: what is guarded (ASGI).
        token: of this start.
        port: of this start.
    """

    def __init__(self, application: ASGIApp, *, token: str, port: int) -> None:
        self.application = application
        self.token = token
        self.cookie = f"imr_torch_{port}"
        self.hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, set the cookie, or refuse."""
        send = _with_headers(send)
        answer: ASGIApp = self.application
        if scope["type"] in ("http", "websocket"):
            asked = HTTPConnection(scope)
            here = self._is_here(asked.headers)
            if here and self._is_token(asked.cookies.get(self.cookie, "")):
                pass
            elif scope["type"] == "websocket":
                answer = WebSocketClose(1008)
            elif here and self._is_token(asked.query_params.get("token", "")):
                cookie = f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                headers = {"set-cookie": cookie, "cache-control": "no-store"}
                answer = RedirectResponse(scope["path"], 303, headers)
            else:
                answer = PlainTextResponse(
                    "This is not the address that imr-torch app printed. Open that one, with its "
                    "token, on the machine that it runs on.",
                    403,
                    {"cache-control": "no-store"},
                )
        await answer(scope, receive, send)

    def _is_here(self, headers: Headers) -> bool:
        origins = {None, *(f"http://{host}" for host in self.hosts)}
        return headers.get("host") in self.hosts and headers.get("origin") in origins

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode(), self.token.encode())


def _with_headers(send: Send) -> Send:
    """Adds the headers that keep pages from loading anything from elsewhere.

    A policy that is set already stays.
    """

    async def send_headed(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return send_headed
