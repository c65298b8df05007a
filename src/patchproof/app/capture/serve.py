"""Serve the capture page on this machine, or on request on the local network, until interrupted.

In: a sheet's manifest, the folder for the photographs. Out: the last `Report`. The address has a random token. Port and
token are stored for the user and not in the folder, which may have come from somebody who knows them. HTTP is not
encrypted: in a network of strangers serve this machine only. Left out on purpose: live pictures, which browsers allow
to encrypted pages only.
"""

import hashlib
import os
import secrets
import socket
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import Field

from patchproof.app.capture.album import Album
from patchproof.app.capture.collection import PhotoCollection, prepare_worker
from patchproof.app.verify import options_of
from patchproof.base.errors import Refused
from patchproof.base.folder_lock import lock_folder
from patchproof.base.input import read_json
from patchproof.base.output import make_folder, write_atomically
from patchproof.base.progress import Progress, no_progress
from patchproof.base.validation import StrictModel, validate_model
from patchproof.base.workers import open_workers
from patchproof.evidence.results import Report
from patchproof.sheets.manifest import load_manifest

_TEST_ADDRESS = ("192.0.2.1", 9)  # reserved for documentation: connecting a datagram socket to it sends nothing


class _Address(StrictModel):
    token: Annotated[str, Field(pattern="^[A-Za-z0-9_-]{22,64}$")]
    port: Annotated[int, Field(ge=0, le=65535)]


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
            path = _address_file(album.folder)
            address = _stored_address(path)
            with _listen(_host(lan), address.port) as listener:
                host, port = listener.getsockname()
                with suppress(Refused):  # without a place for it, the next server has a new address
                    make_folder(path.parent)
                    path.parent.chmod(0o700)
                    write_atomically(path, address.changed(port=port).model_dump_json())
                on_address(f"http://{host}:{port}/{address.token}/")
                try:
                    uvicorn.Server(server_config(collection, address.token)).run(sockets=[listener])
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


def _address_file(folder: Path) -> Path:
    """The file with the address of a folder's server, among what programs keep for this user on this machine."""
    state = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    return Path(state, "patchproof", "capture", f"{hashlib.sha256(os.fsencode(folder)).hexdigest()}.json")


def _stored_address(path: Path) -> _Address:
    """Token and port of the last server; a new token if there is none."""
    try:
        return validate_model(_Address, read_json(path, "an address", "remove it"), path.name)
    except Refused:
        return _Address(token=secrets.token_urlsafe(24), port=0)
