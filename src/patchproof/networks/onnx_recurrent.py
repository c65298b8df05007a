"""ONNX's LSTM, GRU and RNN, written with torch; see onnx_operators.py for the rules."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

MAX_STEPS = 1 << 12  # of a sequence, one after the other


def recurrent(
    name: str, compute: Callable[..., Any], gates: list[int], usual_activations: list[str]
) -> Callable[..., tuple[Tensor, ...]]:
    """A recurrent layer of one or two directions; `gates` are torch's in ONNX's order."""

    def gates_in_torchs_order(weights: Tensor) -> Tensor:
        return weights.unflatten(1, (len(gates), -1))[:, gates].flatten(1, 2)

    def computed(
        x, w, r, b=None, lengths=None, h=None, c=None, peepholes=None, /, *, hidden_size, activations=None,
        direction="forward", input_forget=0, linear_before_reset=0
    ):  # fmt: skip
        directions = len(w)
        if activations not in (None, usual_activations * directions) or input_forget:
            raise ValueError(f"a {name} with {activations}")
        if lengths is not None or peepholes is not None or (name == "GRU" and not linear_before_reset):
            raise ValueError(f"a {name} with lengths, peepholes, or a reset before the product")
        if len(x) > MAX_STEPS:
            raise ValueError(f"a sequence of {len(x)} steps")
        zeros = x.new_zeros(directions, x.shape[1], hidden_size)
        states = [zeros if state is None else state for state in (h, c)]
        parts = [gates_in_torchs_order(part) for part in (w, r, *(() if b is None else b.chunk(2, 1)))]
        weights = [part[direction] for direction in range(directions) for part in parts]
        backward = direction == "reverse"
        start = tuple(states) if name == "LSTM" else states[0]
        options = (b is not None, 1, 0.0, False, directions == 2, False)
        y, *last = compute(x.flip(0) if backward else x, start, weights, *options)
        y = (y.flip(0) if backward else y).unflatten(2, (directions, hidden_size)).transpose(1, 2)
        return (y, *last)

    return computed
