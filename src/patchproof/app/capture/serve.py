"""Serve the capture page on this machine, or on request on the local network, until interrupted.

In: a sheet's manifest, the folder for the photographs. Out: the last `Report`. The address has a random token. Port and
token are stored in the folder, readable by its owner only, so that an open page continues after a restart. HTTP is not
encrypted: in a network of strangers serve this machine only. Left out on purpose: live pictures, which browsers allow
to encrypted pages only; the phone's camera app takes better ones.
"""

from __future__ import annotations

import os
import secrets
import socket
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import Field

from patchproof.app.capture.album import ADDRESS_FILE, Album
from patchproof.app.capture.collection import PhotoCollection, prepare_worker
from patchproof.app.verify import options_of
from patchproof.base.errors import Refused
from patchproof.base.input import read_json
from patchproof.base.output import write_atomically
from patchproof.base.progress import Progress, no_progress
from patchproof.base.validation import StrictModel, validate_model
from patchproof.base.workers import open_workers
from patchproof.evidence.results import Report
from patchproof.sheets.manifest import load_manifest

_TEST_ADDRESS = ("192.0.2.1", 9)  # reserved for documentation: connecting a datagram socket to it sends nothing
_MOST_CONNECTIONS = 64


class _Address(StrictModel):
    token: Annotated[str, Field(pattern="^[A-Za-z0-9_-]{22,64}$")]
    port: Annotated[int, Field(ge=0, le=65535)]

    def write(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
            file.write(self.model_dump_json())


def serve_capture(
    sheet: str | Path,
    out: str | Path,
    *,
    run: str | Path | None = None,
    models: Sequence[str] | None = None,
    camera: str | None = None,
    trust: bool = False,
    lan: bool = False,
    progress: Progress = no_progress,
    on_address: Callable[[str], None] = print,
) -> Report:
    """Serve the page and receive photographs into the folder `out` until interrupted; returns the report on them.

    `progress` is called with the stage "measure" for photographs that are there already, `on_address` with the address
    once the server listens. `run`, `models`, `camera` and `trust` are those of `verify`.
    """
    try:
        import uvicorn

        from patchproof.app.capture.app import capture_app
    except ImportError:
        raise Refused("Starlette and uvicorn", "none", "pip install 'patchproof[capture]'") from None
    manifest = load_manifest(sheet)
    if manifest.promise is None:
        got = f"the {manifest.kind} sheet {manifest.sheet_id}"
        raise Refused("a sheet that promises something", got, "photograph it with any camera")
    options = options_of(sheet, manifest, models, camera, trust)
    forecast = None if run is None else (Path(run).resolve(), Path(sheet).resolve(), trust, tuple(models or ()))
    album = Album(Path(out))
    with open_workers(1, spawn=True) as workers:
        workers.map(prepare_worker, [None])
        with closing(PhotoCollection(album, manifest, options, workers, forecast)) as collection:
            collection.measure(album.photos(), partial(progress, "measure"))
            address = _stored_address(album.folder)
            with _listen(_host(lan), address.port) as listener:
                host, port = listener.getsockname()
                write_atomically(album.folder / ADDRESS_FILE, address.changed(port=port).write)
                on_address(f"http://{host}:{port}/{address.token}/")
                config = uvicorn.Config(
                    capture_app(collection, address.token),
                    http="h11",
                    ws="none",
                    lifespan="off",
                    log_level="warning",
                    access_log=False,  # it would contain the token
                    server_header=False,
                    limit_concurrency=_MOST_CONNECTIONS,
                    timeout_graceful_shutdown=2,
                )
                try:
                    uvicorn.Server(config).run(sockets=[listener])
                except KeyboardInterrupt:  # the way to end the server
                    pass
            return collection.report()


def _listen(host: str, port: int) -> socket.socket:
    """Listen at that port, or at a free one if it is taken."""
    for wanted in dict.fromkeys((port, 0)):
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, os.name != "nt")
        try:
            listener.bind((host, wanted))
            listener.listen()  # requests that come before the server is ready wait
            return listener
        except OSError as error:
            listener.close()
            if not wanted:
                got = f"an error on {host}: {error.strerror}"
                raise Refused("a port to listen at", got, "free a port, or check the network") from error
    raise AssertionError("port 0 is always tried")


def _host(lan: bool) -> str:
    """The one address to serve at; never all that this machine has."""
    return _network_address() if lan else "127.0.0.1"


def _network_address() -> str:
    """This machine's address in its local network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_TEST_ADDRESS)
            return probe.getsockname()[0]
        except OSError as error:
            do = "connect to one, or leave --lan out"
            raise Refused("a local network", f"none ({error.strerror})", do) from error


def _stored_address(folder: Path) -> _Address:
    """Token and port of the last server for this folder; a new token if there is none."""
    try:
        return validate_model(_Address, read_json(folder / ADDRESS_FILE, "an address", "remove it"), ADDRESS_FILE)
    except Refused:
        return _Address(token=secrets.token_urlsafe(24), port=0)
