"""Connect to a Dask cluster."""

from typing import Any

from patchproof.base.errors import Refused

_CONNECT_TIMEOUT_S = 10


def connect_client(address: str) -> Any:
    """A client of the scheduler at an address; refused if there is none."""
    try:
        from distributed import Client
    except ImportError:
        raise Refused("dask.distributed for --cluster", "none", 'pip install "patchproof[cluster]"') from None
    try:
        return Client(address, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        do = "start dask scheduler there, or correct the address"
        raise Refused("a Dask scheduler, such as tcp://host:8786", f"{address} ({reason})", do) from error
