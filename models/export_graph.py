"""Makes an exported graph small: formulas over vectors and matrices become the few scalar operations that matter.

Effects are written for reading and for thousands of samples at once: they stack columns into vectors and matrices, take
elements out again, and multiply by zero to get a column of zeros. In a graph for one sample every such step costs as
much as a product. The rules here undo them, on the graph that torch traced, without changing what it computes.
"""

from __future__ import annotations

import sys
from typing import Any

import torch
from torch.fx import Graph, Node

aten = torch.ops.aten
STACK, SELECT, UNSQUEEZE = aten.stack.default, aten.select.int, aten.unsqueeze.default
ADD, SUB, MUL, NEG = aten.add.Tensor, aten.sub.Tensor, aten.mul.Tensor, aten.neg.default


def simplify(program: torch.export.ExportedProgram) -> torch.export.ExportedProgram:
    """`program` with vectors resolved into their elements; its graph is changed in place."""
    graph = program.graph_module.graph
    for rule in (_whole_slices, _elements, _zeros, _elements, _zeros):
        rule(graph)
        _drop_doubles(graph)
        graph.eliminate_dead_code()
    graph.lint()
    program.graph_module.recompile()
    return program


def _is(node: object, target: Any) -> bool:
    return isinstance(node, Node) and node.op == "call_function" and node.target is target


def _whole_slices(graph: Graph) -> None:
    """`x[:]` is x."""
    for node in graph.nodes:
        if _is(node, aten.slice.Tensor) and tuple(node.args[2:]) == (0, sys.maxsize):
            node.replace_all_uses_with(node.args[0])


def _new(graph: Graph, target: Any, like: Node, shape: tuple[Any, ...], *args: Any) -> Node:
    """A node before the current insertion point, with the value that later rules and the exporter look at."""
    made = graph.call_function(target, args)
    value = like.meta["val"]
    made.meta = {**like.meta, "val": value.new_empty(shape)}
    return made


def _elements(graph: Graph) -> None:
    """An element of a stack is what was stacked; an operation on stacks is a stack of operations."""
    for node in list(graph.nodes):
        if _is(node, SELECT) and _is(node.args[0], STACK):
            _resolve(graph, node)
        elif node.op == "call_function" and node.target in (ADD, SUB, MUL) and len(node.args) == 2:
            a, b = (_columns(side) for side in node.args)
            if a is None or b is None or not any(_is(side, STACK) for side in node.args):
                continue
            with graph.inserting_before(node):
                column = node.meta["val"].shape[:1]
                done = [_new(graph, node.target, node, column, *pair) for pair in zip(a, b, strict=True)]
                made = _new(graph, STACK, node, node.meta["val"].shape, done, -1)
            node.replace_all_uses_with(made)
        elif _is(node, NEG) and _is(node.args[0], STACK) and node.meta["val"].ndim == 2:
            parts = _columns(node.args[0])
            assert parts is not None
            with graph.inserting_before(node):
                column = node.meta["val"].shape[:1]
                made = _new(
                    graph,
                    STACK,
                    node,
                    node.meta["val"].shape,
                    [_new(graph, NEG, node, column, part) for part in parts],
                    -1,
                )
            node.replace_all_uses_with(made)


def _resolve(graph: Graph, node: Any) -> None:
    """Replace an element of a stack by what was stacked, or by the stack of its parts' elements."""
    stack, axis, index = node.args
    parts, dimension = list(stack.args[0]), _dimension(stack)
    axis %= _dimensions(stack)
    if axis == dimension:
        node.replace_all_uses_with(parts[index])
        return
    inner = axis - (axis > dimension)
    shape = tuple(s for i, s in enumerate(parts[0].meta["val"].shape) if i != inner)
    with graph.inserting_before(node):
        elements = []
        for part in parts:
            if _is(part, STACK) and inner == _dimension(part):
                elements.append(part.args[0][index])
            else:
                elements.append(_new(graph, SELECT, node, shape, part, inner, index))
        made = _new(graph, STACK, node, node.meta["val"].shape, elements, dimension - (axis < dimension))
    node.replace_all_uses_with(made)


def _dimensions(node: Any) -> int:
    """Number of dimensions."""
    return int(node.meta["val"].ndim)


def _dimension(stack: Any) -> int:
    axis = stack.args[1] if len(stack.args) > 1 else 0
    return int(axis) % _dimensions(stack)


def _columns(node: Any) -> list[Node] | None:
    """Three columns (N,) of something that has the shape (N, 3): a stack of them, or one column for all."""
    if _is(node, STACK) and _dimensions(node) == 2 and _dimension(node) == 1:
        return list(node.args[0])
    if _is(node, UNSQUEEZE) and node.args[1] in (1, -1) and _dimensions(node.args[0]) == 1:
        return [node.args[0]] * 3
    return None


def _zeros(graph: Graph) -> None:
    """Nothing plus x is x, and nothing times x is nothing."""
    nothing: set[Node] = set()
    for node in list(graph.nodes):
        if node.op != "call_function" or node.meta["val"].ndim != 1:
            continue
        args = node.args
        empty = [isinstance(a, Node) and a in nothing for a in args]
        if (node.target is MUL and (any(empty) or 0.0 in [a for a in args if isinstance(a, float)])) or (
            node.target is NEG and empty[0]
        ):
            nothing.add(node)
        elif node.target in (ADD, SUB) and len(args) == 2:
            a, b = args
            if all(empty):
                nothing.add(node)
            elif empty[1]:
                node.replace_all_uses_with(a)
            elif empty[0] and node.target is ADD and isinstance(b, Node):
                node.replace_all_uses_with(b)


def _drop_doubles(graph: Graph) -> None:
    """What is computed twice is computed once."""
    seen: dict[Any, Node] = {}
    for node in list(graph.nodes):
        if node.op != "call_function":
            continue
        key = (node.target, str(node.args), str(node.kwargs))
        if key in seen:
            node.replace_all_uses_with(seen[key])
        else:
            seen[key] = node
