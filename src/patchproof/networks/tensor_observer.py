"""Looking at every tensor that operators make, also on their way."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode


class TensorObserver(TorchDispatchMode):
    """While it is entered, `look` sees each tensor that an operator, or what stands in `instead` of it, makes."""

    def __init__(self, look: Callable[[Tensor], None], instead: Mapping[Any, Callable[..., Any]] | None = None):
        super().__init__()
        self._look, self._instead = look, instead or {}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing here is compiled; to be told so, torch would import its compiler."""
        return False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        compute: Any = self._instead.get(func, func)
        results = compute(*args, **(kwargs or {}))
        for value in results if isinstance(results, (list, tuple)) else [results]:
            if isinstance(value, Tensor):
                self._look(value)
        return results
