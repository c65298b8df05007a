"""A printer without a name, carried by value in a sheet's settings: a sheet may lie anywhere, without its scene."""

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused
from patchproof.channel.printer import Printer, printer_files, printer_of_files


def carried_printer(path: Path) -> dict[str, Any]:
    """Return both files of a printer as JSON values."""
    tables, head = printer_files(path)
    return {"npz": base64.b64encode(tables).decode(), "head": head}


def printer_of_sheet(carried: Mapping[str, Any], source: str | Path) -> Printer:
    """Return a printer from what `carried_printer` made of it; `source` names the sheet in a refusal."""
    try:
        tables = base64.b64decode(carried["npz"], validate=True)
    except ValueError as error:
        raise Refused("a printer's tables in base64", f"{source} with other text", "make the sheet again") from error
    return printer_of_files(tables, carried["head"], source)
