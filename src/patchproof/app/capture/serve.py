"""Serve the capture page on this machine, or on request on the local network, until interrupted.

In: a sheet's manifest, the folder for the photographs. Out: the last `Report`. The address has a random token, another
one with each start. HTTP is not encrypted: in a network of strangers serve this machine only. Left out on purpose: live
pictures, which browsers allow to encrypted pages only.
"""

import secrets
import socket
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from patchproof.app.capture.album import Album
from patchproof.app.capture.collection import PhotoCollection, prepare_worker
from patchproof.app.verify import options_of
from patchproof.base.errors import Refused
from patchproof.base.folder_lock import lock_folder
from patchproof.base.progress import Progress, no_progress
from patchproof.base.workers import open_workers
from patchproof.evidence.results import Report
from patchproof.sheets.manifest import load_manifest

_TEST_ADDRESS = ("192.0.2.1", 9)  # reserved for documentation: connecting a datagram socket to it sends nothing


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
    try:
        import uvicorn

        from patchproof.app.capture.app import server_config
    except ImportError:
        raise Refused("Starlette and uvicorn", "none", "pip install 'patchproof[capture]'") from None
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
