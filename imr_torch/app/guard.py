"""Who may connect: this machine alone, with the token of this start.

The server listens on 127.0.0.1. Other programs and web pages on the same machine could still reach
it, so every request needs a cookie that only the link with the token sets, must name this machine
as its host (against names that are bound to it later), and must not come from a page of another
origin. Pages may load nothing from elsewhere.
"""

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

_POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; frame-ancestors 'self'; form-action 'self'"
)
_HEADERS = (
    (b"content-security-policy", _POLICY.encode()),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
)


class Guard:
    """Refuses what does not come from the person who started the application.

    Args:
        application: what is guarded (ASGI).
        token: of this start.
        port: of this start.
    """

    def __init__(self, application: Application, *, token: str, port: int) -> None:
        self.application = application
        self.token = token
        self.cookie = f"imr_torch_{port}"
        self.hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, set the cookie, or refuse."""
        if scope["type"] not in ("http", "websocket"):
            await self.application(scope, receive, send)
            return
        headers = {
            name.decode("latin-1").lower(): value.decode("latin-1")
            for name, value in scope["headers"]
        }
        if not self._is_here(headers):
            await _refuse(scope, send)
        elif self._same(_cookie(headers.get("cookie", ""), self.cookie)):
            await self.application(scope, receive, _with_headers(send))
        elif scope["type"] == "http" and self._same(
            parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        ):
            cookie = f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            await _answer(
                send,
                303,
                "",
                ((b"set-cookie", cookie.encode()), (b"location", scope["path"].encode("latin-1"))),
            )
        else:
            await _refuse(scope, send)

    def _is_here(self, headers: dict[str, str]) -> bool:
        origin = headers.get("origin")
        return headers.get("host") in self.hosts and (
            origin is None or origin in {f"http://{host}" for host in self.hosts}
        )

    def _same(self, given: str) -> bool:
        return secrets.compare_digest(given.encode(), self.token.encode())


def _cookie(text: str, name: str) -> str:
    try:
        found = SimpleCookie(text).get(name)
    except CookieError:
        return ""
    return found.value if found else ""


def _with_headers(send: Send) -> Send:
    """Adds the headers that keep pages from loading anything from elsewhere.

    A policy that is set already stays.
    """

    async def sent(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            known = {name.lower() for name, _ in message.get("headers", ())}
            added = [header for header in _HEADERS if header[0] not in known]
            message = {**message, "headers": [*message.get("headers", ()), *added]}
        await send(message)

    return sent


async def _refuse(scope: Scope, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    text = (
        "This is not the address that imr-torch app printed. Open that one, with its token, on "
        "the machine that it runs on."
    )
    await _answer(send, 403, text)


async def _answer(
    send: Send, status: int, text: str, headers: tuple[tuple[bytes, bytes], ...] = ()
) -> None:
    plain = ((b"content-type", b"text/plain; charset=utf-8"), (b"cache-control", b"no-store"))
    await send(
        {
            "type": "http.response.start",
            "status": status,
            "headers": [*plain, *_HEADERS[1:], *headers],
        }
    )
    await send({"type": "http.response.body", "body": text.encode()})
