"""Serve the capture page and its JSON over HTTP, behind a token, until interrupted; files are never served.

    GET /TOKEN/            the page           POST /TOKEN/photos?into=NAME   one photograph, its bytes as the body
    GET /TOKEN/state       JSON               POST /TOKEN/sessions           begin a new session
    POST /TOKEN/corners?of=FOLDER/NAME&numbers=X,Y,...,WIDTH,HEIGHT          the design's corners that a person tapped

In: a sheet's manifest, the folder for the photographs, requests of anybody who reaches the port. Out: the page,
`state_of`, `answer_of`, or a refusal in one sentence; in the end the last `Report`. A photograph is the whole body,
without a name that would have to be trusted; a body that stops or stalls leaves no file. Photographs are measured one
at a time; the same bytes get the same answer, so that a page that lost its connection can send them again. An answer
ends its connection, and one that has not shown the token loses its place to whoever comes later, so that silent ones
cannot keep the owner out. The address has a random token, another one with each start. HTTP is not encrypted: in a
network of strangers serve this machine only. Left out on purpose: live pictures, which browsers allow to encrypted
pages only.
"""

import asyncio
import hmac
import secrets
import socket
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import anyio
import uvicorn
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from patchproof.app.capture.album import MOST_BYTES, Album, UploadRefused, refuse_size
from patchproof.app.capture.collection import PhotoCollection, answer_of, prepare_worker, state_of
from patchproof.app.verify import options_of
from patchproof.base.errors import Refused
from patchproof.base.folder_lock import lock_folder
from patchproof.base.progress import Progress, no_progress
from patchproof.base.workers import open_workers
from patchproof.evidence.results import Report
from patchproof.evidence.verdict import sessions_needed
from patchproof.report.page import render_page
from patchproof.sheets.manifest import load_manifest

if TYPE_CHECKING:
    from starlette.types import Receive, Scope, Send

_TEST_ADDRESS = ("192.0.2.1", 9)  # reserved for documentation: connecting a datagram socket to it sends nothing
STALLED_S = 30.0  # without a byte: a phone out of reach does not close its connection
LEAST_BYTES_PER_S = 20_000  # of a whole photograph, after `STALLED_S`
_MOST_UPLOADS = 8  # at once; more wait before their body is read
TOKEN_SHOWN_S = 10.0  # from a connection to the end of a request's head; whoever takes longer loses its place
MOST_STRANGERS, _MOST_CONNECTIONS = 32, 64  # connections that have not shown the token, and all
_Client = tuple[str, int] | None
_HEADERS = [
    ("Cache-Control", "no-store"),
    ("Referrer-Policy", "no-referrer"),
    ("X-Content-Type-Options", "nosniff"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Connection", "close"),
]


def server_config(collection: PhotoCollection, token: str) -> uvicorn.Config:
    """Settings of a server for a collection of photographs; it answers requests with the token only."""
    strangers: dict[_Client, asyncio.Transport] = {}  # the oldest first

    def expel(client: _Client, transport: asyncio.Transport) -> None:
        if strangers.get(client) is transport:
            strangers.pop(client).abort()

    class Connection(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:
            super().connection_made(transport)
            strangers[self.client] = transport
            self.loop.call_later(TOKEN_SHOWN_S, expel, self.client, transport)
            if len(strangers) > MOST_STRANGERS:
                expel(*next(iter(strangers.items())))

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            strangers.pop(self.client, None)

    handlers = _Handlers(collection)
    routes = [
        Route(f"/{token}/", handlers.page, methods=["GET"]),
        Route(f"/{token}/state", handlers.state, methods=["GET"]),
        Route(f"/{token}/photos", handlers.photo, methods=["POST"]),
        Route(f"/{token}/sessions", handlers.session, methods=["POST"]),
        Route(f"/{token}/corners", handlers.corners, methods=["POST"]),
    ]
    app = Starlette(routes=routes, exception_handlers={Refused: _refuse, OSError: _refuse})
    app.router.redirect_slashes = False

    async def check_token(scope: "Scope", receive: "Receive", send: "Send") -> None:
        """Check the token, in constant time, before anything else of a request is read."""
        if scope["type"] != "http":
            return
        shown = scope["path"].lstrip("/").partition("/")[0]
        if not hmac.compare_digest(shown.encode("utf-8", "surrogateescape"), token.encode()):
            sentence = "Expected the address that the terminal shows, got one without its token: open that address."
            return await _refusal(403, sentence)(scope, receive, send)
        strangers.pop(scope["client"], None)
        await app(scope, receive, send)

    return uvicorn.Config(
        check_token,
        http=Connection,
        headers=_HEADERS,
        ws="none",
        lifespan="off",
        log_level="warning",
        access_log=False,  # it would contain the token
        server_header=False,
        proxy_headers=False,  # a client is known by its own address
        limit_concurrency=_MOST_CONNECTIONS,
        timeout_graceful_shutdown=2,
    )


class _Handlers:
    """The routes' handlers, and the state that they share."""

    def __init__(self, collection: PhotoCollection):
        self._collection, self._planned_sessions = collection, sessions_needed(collection.promise)
        self._state = state_of(collection, self._planned_sessions)
        self._one_at_a_time, self._receiving = anyio.Lock(), anyio.Semaphore(_MOST_UPLOADS)

    async def page(self, request: Request) -> Response:
        """The page; its policy allows only its own scripts and styles, and requests to this server."""
        sheet_id, target = self._collection.manifest.sheet_id, self._collection.promise.target
        values = {"nonce": (nonce := secrets.token_urlsafe(16)), "sheet_id": sheet_id, "target": target}
        html = render_page("page.html.j2", Path(__file__).parent, **values, most_bytes=MOST_BYTES)
        policy = (
            f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self'; "
            "img-src data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        return HTMLResponse(html, headers={"Content-Security-Policy": policy})

    async def state(self, request: Request) -> Response:
        """The state of all photographs so far, as JSON."""
        return JSONResponse(self._state)

    async def session(self, request: Request) -> Response:
        """Begin a new session."""
        async with self._one_at_a_time:
            name = self._collection.album.new_session()
            self._state = await anyio.to_thread.run_sync(state_of, self._collection, self._planned_sessions)
        return JSONResponse({"session": name, "state": self._state})

    async def photo(self, request: Request) -> Response:
        """Receive one photograph, measure it and answer."""
        length = request.headers.get("content-length", "")
        refuse_size(int(length[:18]) if length.isdecimal() else 0)
        async with self._receiving:
            try:
                path = await self._receive(request)
            except (ClientDisconnect, TimeoutError):
                return _refusal(408, "Expected a whole photograph, got only a part of it: send it again.")
        async with self._one_at_a_time:
            return JSONResponse(await anyio.to_thread.run_sync(self._measure, path))

    async def corners(self, request: Request) -> Response:
        """Measure a photograph again by the design's corners, which a person tapped in a picture of it, and answer."""
        file, numbers = request.query_params.get("of", ""), request.query_params.get("numbers", "")
        async with self._one_at_a_time:
            try:
                path = await anyio.to_thread.run_sync(self._collection.name_corners, file, numbers)
            except Refused as error:
                return _refusal(422, str(error))
            return JSONResponse(await anyio.to_thread.run_sync(self._measure, path))

    async def _receive(self, request: Request) -> Path:
        with self._collection.album.incoming(request.query_params.get("into", "")) as incoming:
            chunks, end = request.stream(), anyio.current_time() + STALLED_S
            while True:
                with anyio.fail_after(min(STALLED_S, end - anyio.current_time())):
                    chunk = await anext(chunks, None)
                if chunk is None:
                    return incoming.keep()
                incoming.write(chunk)
                end += len(chunk) / LEAST_BYTES_PER_S

    def _measure(self, path: Path) -> dict[str, Any]:
        collection, pictures = self._collection, []
        collection.measure([path], on_pictures=lambda file, kinds: pictures.append(kinds.get("photo")))
        self._state = state_of(collection, self._planned_sessions)
        return {"photo": answer_of(collection, path, pictures[0] if pictures else None), "state": self._state}


async def _refuse(_: Request, error: Exception) -> Response:
    """Answer with a refusal's sentence, or with that of a disk that takes no more."""
    if isinstance(error, OSError):
        error = Refused("room for a photograph", error.strerror or str(error), "make room and send it again")
    return _refusal(error.status if isinstance(error, UploadRefused) else 507, str(error))


def _refusal(status: int, sentence: str) -> Response:
    return JSONResponse({"refused": sentence}, status)


def serve_capture(
    sheet: str | Path,
    out: str | Path,
    *,
    models: Sequence[str] | None = None,
    camera: str | None = None,
    trust: bool = False,
    lan: bool = False,
    progress: Progress = no_progress,
    on_address: Callable[[str], None] = print,
) -> Report:
    """Serve the page and receive photographs into the folder `out` until interrupted; returns the report on them.

    `progress` is called with the stage "measure" for photographs that are there already, `on_address` with the address
    once the server listens. `models`, `camera` and `trust` are those of `verify`.
    """
    manifest = load_manifest(sheet)
    if manifest.promise is None:
        got = f"the {manifest.kind} sheet {manifest.sheet_id}"
        raise Refused("a sheet that promises something", got, "photograph it with any camera")
    options = replace(options_of(sheet, manifest, models, camera, trust), find=not manifest.markers)
    with lock_folder(out), open_workers(1, spawn=True) as workers:
        album = Album(Path(out))
        workers.map(prepare_worker, [None])
        with closing(PhotoCollection(album, manifest, options, workers)) as collection:
            collection.measure(album.photos(), partial(progress, "measure"))
            # never at all the addresses that this machine has; requests that come before it is ready wait
            with _listen(_network_address() if lan else "127.0.0.1") as listener:
                (host, port), token = listener.getsockname(), secrets.token_urlsafe(24)
                on_address(f"http://{host}:{port}/{token}/")
                with suppress(KeyboardInterrupt):  # the way to end the server
                    uvicorn.Server(server_config(collection, token)).run(sockets=[listener])
            return collection.report()


def _listen(host: str) -> socket.socket:
    """Listen at a free port."""
    try:
        return socket.create_server((host, 0))
    except OSError as error:
        got = f"an error on {host}: {error.strerror}"
        raise Refused("a port to listen at", got, "free a port, or check the network") from error


def _network_address() -> str:
    """This machine's address in its local network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_TEST_ADDRESS)
            return probe.getsockname()[0]
        except OSError as error:
            do = "connect to one, or leave --lan out"
            raise Refused("a local network", f"none ({error.strerror})", do) from error
