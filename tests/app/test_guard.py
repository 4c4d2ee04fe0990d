"""The application answers the person who started it, and nobody else."""

import asyncio
from typing import Any

import pytest

from imr_torch.app.guard import Guard

TOKEN = "right-token"
PORT = 8123


async def inside(scope: Any, receive: Any, send: Any) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


def ask(
    headers: dict[str, str], query: str = "", kind: str = "http"
) -> list[dict[str, Any]]:
    sent: list[dict[str, Any]] = []

    async def send(message: Any) -> None:
        sent.append(message)

    pairs = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": kind, "path": "/", "query_string": query.encode(), "headers": pairs}
    asyncio.run(Guard(inside, token=TOKEN, port=PORT)(scope, None, send))  # type: ignore[arg-type]
    return sent


HERE = {"host": f"127.0.0.1:{PORT}"}
COOKIE = {"cookie": f"other=1; imr_torch_{PORT}={TOKEN}"}


def test_that_the_link_sets_a_cookie_that_scripts_and_other_sites_do_not_get_and_leaves_the_token_out():
    start = ask(HERE, f"token={TOKEN}")[0]
    headers = dict(start["headers"])
    assert (start["status"], headers[b"location"]) == (303, b"/")
    assert all(
        part in headers[b"set-cookie"]
        for part in (TOKEN.encode(), b"HttpOnly", b"SameSite=Strict")
    )


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_that_the_cookie_opens(kind):
    first = ask(HERE | COOKIE | {"origin": f"http://127.0.0.1:{PORT}"}, kind=kind)[0]
    assert first.get("status", 200) == 200
    assert first["type"] in ("http.response.start", "websocket.accept")


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    ("headers", "query"),
    [
        (HERE, ""),
        (HERE, "token=wrong"),
        (HERE | {"cookie": f"imr_torch_{PORT}=wrong"}, ""),
        (HERE | {"cookie": f"imr_torch_{PORT + 1}={TOKEN}"}, ""),
        (COOKIE, ""),
        (COOKIE | {"host": f"evil.example:{PORT}"}, f"token={TOKEN}"),
        (HERE | COOKIE | {"origin": "http://evil.example"}, ""),
        (HERE | COOKIE | {"origin": "null"}, ""),
    ],
)
def test_that_everything_else_is_refused(headers, query, kind):
    (first, *_) = ask(headers, query, kind)
    assert first.get("status", first.get("code")) == (403 if kind == "http" else 1008)


def test_that_a_websocket_needs_the_cookie_even_with_the_token():
    assert ask(HERE, f"token={TOKEN}", "websocket")[0]["code"] == 1008


def test_that_pages_may_load_nothing_from_elsewhere_and_a_stricter_policy_stays():
    headers = dict(ask(HERE | COOKIE)[0]["headers"])
    assert b"default-src 'self'" in headers[b"content-security-policy"]
    assert b"http:" not in headers[b"content-security-policy"]
