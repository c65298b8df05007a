"""Places for connections: whoever has shown no token loses its place to whoever comes later.

In: the application. Out: uvicorn's settings for it. A connection that has not shown the token is closed after a while,
or when more than `MOST_STRANGERS` have not, the oldest first, so that silent ones cannot keep the owner out. One answer
ends a connection, since an idle one holds a place, too.
"""

from __future__ import annotations

import asyncio

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from patchproof.app.capture.app import capture_app
from patchproof.app.capture.collection import PhotoCollection

TOKEN_SHOWN_S = 10.0  # from the connection to the end of a request's head
MOST_STRANGERS = 32
_MOST_CONNECTIONS = 64
_Client = tuple[str, int] | None


def server_config(collection: PhotoCollection, token: str) -> uvicorn.Config:
    """Settings of a server for a collection of photographs, with the application `capture_app`."""
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

    return uvicorn.Config(
        capture_app(collection, token, lambda client: strangers.pop(client, None)),
        http=Connection,
        ws="none",
        lifespan="off",
        log_level="warning",
        access_log=False,  # it would contain the token
        server_header=False,
        proxy_headers=False,  # a client is known by its own address
        limit_concurrency=_MOST_CONNECTIONS,
        timeout_graceful_shutdown=2,
    )
