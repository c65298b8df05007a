"""Observe every tensor that operators create, also inside other operators."""

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode


class TensorObserver(TorchDispatchMode):
    """A context that calls `look` with each tensor that an operator, or its stand-in from `instead`, creates, with the
    operator and its arguments.
    """

    def __init__(
        self, look: Callable[[Tensor, Any, tuple], None], instead: Mapping[Any, Callable[..., Any]] | None = None
    ):
        super().__init__()
        self._look, self._instead = look, instead or {}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Answer without torch's own check, which would import its compiler; nothing here is compiled."""
        return False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        compute: Any = self._instead.get(func, func)
        results = compute(*args, **(kwargs or {}))
        for value in results if isinstance(results, (list, tuple)) else [results]:
            if isinstance(value, Tensor):
                self._look(value, func, args)
        return results
