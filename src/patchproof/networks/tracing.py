"""Trace a torch module into numbered steps, where torch.fx can: each module of torch.nn in it is a step.

In: a module in memory, in evaluation mode. Out: a Program that computes the same, or None where control flow depends on
the pictures or steps cannot hold its arguments. torch.fx follows what a module does with one input: callers have to
check that the steps compute the same.
"""

import operator
from functools import reduce
from typing import Any

import torch
from torch.fx import Node, Tracer, map_arg

from patchproof.networks.graph import Program, Step, ValueRef, mark_last_uses, value_numbers


def trace_module(network: torch.nn.Module) -> Program | None:
    """The module's steps for N×3×S×S; None if it cannot be traced."""
    try:
        return _program(network, list(Tracer().trace(network).nodes))
    except Exception:  # it is the user's code, and torch.fx raises whatever it meets
        return None


def _program(network: torch.nn.Module, nodes: list[Node]) -> Program:
    *inner_nodes, output = nodes
    (photos,) = (node for node in inner_nodes if node.op == "placeholder")
    weights = [node for node in inner_nodes if node.op == "get_attr"]
    computed = [node for node in inner_nodes if node.op.startswith("call_")]
    numbers = {node: number for number, node in enumerate([*weights, photos, *computed])}

    def step(node: Node) -> Step:
        arguments = [_argument(argument, numbers) for argument in node.args]
        if node.target is operator.getitem and type(arguments[1]) is list:
            raise TypeError("indexing by a list differs from indexing by a tuple")
        keywords = {name: _argument(argument, numbers) for name, argument in node.kwargs.items()}
        target: Any = node.target
        if node.op == "call_module":
            target = network.get_submodule(target)
        elif node.op == "call_method":
            target = getattr(torch.Tensor, target)
        return Step(target, arguments, keywords, [numbers[node]], False)

    steps, output_number = [step(node) for node in computed], _argument(output.args[0], numbers).number
    mark_last_uses(steps, {*range(len(weights) + 1), output_number})
    tensors: list[Any] = [reduce(getattr, str(node.target).split("."), network) for node in weights]
    return Program([tensor.detach() for tensor in tensors], steps, output_number, None)


def _argument(argument: Any, numbers: dict[Node, int]) -> Any:
    """The argument with values in place of nodes."""
    if isinstance(argument, Node):
        return ValueRef(numbers[argument])
    if isinstance(argument, (list, tuple)):
        items = [_argument(item, numbers) for item in argument]
        return items if any(True for _ in value_numbers(items)) else argument
    named: list[Node] = []
    map_arg(argument, named.append)
    if named:
        raise TypeError("steps hold values in lists only")
    return argument
