"""The page and its JSON over HTTP, behind a token: nothing else is served, no file of the folder is ever read out.

    GET /TOKEN/            the page           POST /TOKEN/photos?into=NAME   one photograph, its bytes as the body
    GET /TOKEN/state       JSON               POST /TOKEN/sessions           begin a new session

In: requests of anybody who reaches the port. Out: the page, `state_of`, `answer_of`, or one sentence that refuses. A
photograph is the whole body, without a form round it and without a name, so that there is no name to be trusted; it is
written as it comes, and a body that stops or stalls leaves nothing. An answer comes when the photograph is measured,
one at a time; bytes that were sent before are answered as before, so a page that lost its connection sends them again.
"""

from __future__ import annotations

import hmac
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Any

import anyio
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route

from patchproof.app.capture.album import MOST_BYTES, UploadRefused, refuse_size
from patchproof.app.capture.collection import PhotoCollection
from patchproof.app.capture.state import answer_of, state_of
from patchproof.evidence.verdict import sessions_needed
from patchproof.report.page import page

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

STALLED_S = 30.0  # without a byte: a phone that went out of reach says no goodbye
_UPLOADS = 8  # at once; more wait before their body is read
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def capture_app(gathered: PhotoCollection, token: str) -> ASGIApp:
    """The application for what is gathered; it answers whoever knows the token."""
    desk = _Desk(gathered)
    routes = [
        Route(f"/{token}/", desk.page, methods=["GET"]),
        Route(f"/{token}/state", desk.state, methods=["GET"]),
        Route(f"/{token}/photos", desk.photo, methods=["POST"]),
        Route(f"/{token}/sessions", desk.session, methods=["POST"]),
    ]
    app = Starlette(routes=routes, exception_handlers={UploadRefused: _refused})
    app.router.redirect_slashes = False
    return _Guard(app, token)


class _Guard:
    """Lets through who knows the token, compared in constant time, before anything else of a request is looked at."""

    def __init__(self, app: ASGIApp, token: str):
        self._app, self._token = app, token.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = [(name.lower().encode(), value.encode()) for name, value in _HEADERS.items()]
                message = {**message, "headers": [*message["headers"], *own]}
            await send(message)

        if scope["type"] != "http":
            return
        given = scope["path"].lstrip("/").partition("/")[0]
        app: ASGIApp = self._app
        if not hmac.compare_digest(given.encode("utf-8", "surrogateescape"), self._token):
            sentence = "Expected the address with its token, got another: open the one that the terminal shows."
            app = JSONResponse({"refused": sentence}, 403, headers={"Connection": "close"})
        await app(scope, receive, with_headers)


class _Desk:
    """What the routes share."""

    def __init__(self, gathered: PhotoCollection):
        self._gathered, promise = gathered, gathered.manifest.promise
        self._planned = None if promise is None else sessions_needed(promise)
        self._state = state_of(gathered, self._planned)
        self._one_at_a_time, self._receiving = anyio.Lock(), anyio.Semaphore(_UPLOADS)

    async def page(self, request: Request) -> Response:
        """The page; scripts and styles of others are not let in, nor requests to others."""
        manifest, nonce = self._gathered.manifest, secrets.token_urlsafe(16)
        target = manifest.promise and manifest.promise.target
        values = {"nonce": nonce, "sheet_id": manifest.sheet_id, "target": target, "most_bytes": MOST_BYTES}
        html = page("page.html.j2", Path(__file__).parent, **values)
        policy = (
            f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self'; "
            "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        return HTMLResponse(html, headers={"Content-Security-Policy": policy})

    async def state(self, request: Request) -> Response:
        """What the photographs say so far."""
        return JSONResponse(self._state)

    async def session(self, request: Request) -> Response:
        """A new session."""
        async with self._one_at_a_time:
            name = self._gathered.album.new_session()
            self._state = await anyio.to_thread.run_sync(state_of, self._gathered, self._planned)
        return JSONResponse({"session": name, "state": self._state})

    async def photo(self, request: Request) -> Response:
        """Receive one photograph and say what it shows."""
        length = request.headers.get("content-length", "")
        refuse_size(int(length[:18]) if length.isdecimal() else 0)
        async with self._receiving:
            try:
                path = await self._received(request)
            except (ClientDisconnect, TimeoutError):
                return _refusal(408, "Expected a whole photograph, got a part: send it again.")
            except OSError as error:
                sentence = f"Expected room for a photograph, got {error.strerror}: make room and send it again."
                return _refusal(507, sentence)
        async with self._one_at_a_time:
            answer = await anyio.to_thread.run_sync(self._measured, path)
        return JSONResponse({"photo": answer, "state": self._state})

    async def _received(self, request: Request) -> Path:
        with self._gathered.album.incoming(request.query_params.get("into", "")) as incoming:
            chunks = request.stream()
            while True:
                with anyio.fail_after(STALLED_S):
                    chunk = await anext(chunks, None)
                if chunk is None:
                    return incoming.keep()
                incoming.write(chunk)

    def _measured(self, path: Path) -> dict[str, Any]:
        gathered, shown = self._gathered, []
        gathered.measure([path], on_pictures=lambda file, kinds: shown.append(kinds.get("photo")))
        self._state = state_of(gathered, self._planned)
        return answer_of(gathered, path, shown[0] if shown else None)


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, UploadRefused)
    return _refusal(error.status, str(error))


def _refusal(status: int, sentence: str) -> Response:
    # a body that was not read to its end is not waited for
    return JSONResponse({"refused": sentence}, status, headers={"Connection": "close"})
