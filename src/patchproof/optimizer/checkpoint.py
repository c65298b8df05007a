"""The checkpoint: everything that the next step depends on, replaced as a whole.

In: a `State` and its problem. Out: `checkpoint.safetensors` in the run's folder, and the state read back. Sizes of
tensors are compared with the problem's start before memory is taken for them.
"""

import json
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field

from patchproof.base.errors import Refused
from patchproof.base.fingerprint import refuse_other_inputs
from patchproof.base.input import is_file
from patchproof.base.output import write_atomically
from patchproof.base.validation import StrictModel
from patchproof.optimizer.loop import State, start
from patchproof.optimizer.problem import Problem

CHECKPOINT_FILE = "checkpoint.safetensors"


def save_checkpoint(state: State, problem: Problem, out: Path) -> None:
    """Replace the checkpoint of the run in `out`."""
    from safetensors.torch import save_file

    tensors = {"design": state.design, "best": state.best}
    tensors |= {f"mean{level}": one for level, one in enumerate(state.mean)}
    tensors |= {f"square{level}": one for level, one in enumerate(state.square)}
    tensors = {name: tensor.cpu().contiguous().clone() for name, tensor in tensors.items()}
    # text keeps every bit of the loss; the sheet id identifies scene and seed
    note = {"number": state.number, "best_loss": state.best_loss.hex(), "sheet_id": problem.scene.sheet_id}
    note |= {"inputs": problem.inputs}
    # a single key, since safetensors writes several in undefined order
    metadata = {"state": json.dumps(note)}
    write_atomically(out / CHECKPOINT_FILE, lambda path: save_file(tensors, path, metadata=metadata))


def load_checkpoint(out: Path, problem: Problem) -> State:
    """The checkpoint's state, or the start where there is no checkpoint; refused where scene or seed differ."""
    path, start_state = out / CHECKPOINT_FILE, start(problem)
    if not is_file(path):
        return start_state
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt", device=str(problem.device)) as file:
            note = _Note.model_validate_json((file.metadata() or {})["state"])
            if note.sheet_id != problem.scene.sheet_id:
                do = "resume with the same scene file and seed, or start in another folder"
                got = f"a checkpoint of sheet {note.sheet_id} in {out}, not {problem.scene.sheet_id}"
                raise Refused("the checkpoint of this scene and seed", got, do)
            refuse_other_inputs(note.inputs, problem.inputs, out, problem.scene.settings.model_dump())
            design, best = _tensor(file, "design", start_state.design), _tensor(file, "best", start_state.design)
            mean = tuple(_tensor(file, f"mean{n}", level) for n, level in enumerate(start_state.mean))
            square = tuple(_tensor(file, f"square{n}", level) for n, level in enumerate(start_state.square))
        return State(note.number, design, mean, square, best, float.fromhex(note.best_loss))
    except Refused:
        raise
    except (SafetensorError, OSError, LookupError, ValueError, ArithmeticError) as error:
        got = f"{path} that cannot be read ({str(error)[:100]})"
        raise Refused("a checkpoint", got, "start in another folder") from error


class _Note(StrictModel):
    number: Annotated[int, Field(ge=0)]
    best_loss: str
    sheet_id: str
    inputs: dict[str, str]


def _tensor(file: Any, name: str, start: torch.Tensor) -> torch.Tensor:
    """The tensor of that name; refused unless it has the size and type of `start` and is finite."""
    if file.get_slice(name).get_shape() != list(start.shape):
        raise ValueError(f"{name} of another size than the scene's design")
    tensor = file.get_tensor(name)
    if tensor.dtype != start.dtype or not bool(torch.isfinite(tensor).all()):
        raise ValueError(f"{name} of type {tensor.dtype} or with infinite values")
    return tensor.clone()  # the file's memory is mapped, and Windows does not replace mapped files
