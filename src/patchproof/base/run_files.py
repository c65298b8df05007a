"""The files that tell how far a run got."""

from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.base.input import is_file

RUN_FILE, CHECKPOINT_FILE = "run.json", "checkpoint.safetensors"


def require_finished_run(folder: Path) -> None:
    """Refuse a folder that holds no run, or an unfinished one."""
    if not is_file(folder / RUN_FILE):
        has_checkpoint = is_file(folder / CHECKPOINT_FILE)
        do = "finish it with --resume" if has_checkpoint else "name the folder that optimize wrote"
        raise Refused("a finished run", f"{'an unfinished one' if has_checkpoint else 'none'} at {folder}", do)
