"""ONNX's LSTM, written with torch; see onnx_operators.py for the rules."""

import torch

MAX_STEPS = 1 << 12  # of a sequence, one after the other
_GATES = [0, 2, 3, 1]  # torch's in ONNX's order


def lstm(
    x, w, r, b=None, lengths=None, h=None, c=None, peepholes=None, /, *, hidden_size, activations=None,
    direction="forward", input_forget=0
):  # fmt: skip
    """A long short-term memory of one or two directions."""
    directions = len(w)
    if activations not in (None, ["Sigmoid", "Tanh", "Tanh"] * directions) or input_forget:
        raise ValueError(f"an LSTM with {activations}")
    if lengths is not None or peepholes is not None:
        raise ValueError("an LSTM with lengths or peepholes")
    if len(x) > MAX_STEPS:
        raise ValueError(f"a sequence of {len(x)} steps")
    zeros = x.new_zeros(directions, x.shape[1], hidden_size)
    states = [zeros if state is None else state for state in (h, c)]
    parts = w, r, *(() if b is None else b.chunk(2, 1))
    parts = [part.unflatten(1, (4, -1))[:, _GATES].flatten(1, 2) for part in parts]
    weights = [part[direction] for direction in range(directions) for part in parts]
    backward = direction == "reverse"
    options = (b is not None, 1, 0.0, False, directions == 2, False)
    y, *last = torch.lstm(x.flip(0) if backward else x, states, weights, *options)
    y = (y.flip(0) if backward else y).unflatten(2, (directions, hidden_size)).transpose(1, 2)
    return (y, *last)
