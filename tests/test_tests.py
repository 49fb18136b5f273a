"""Every test can fail by what it states: an assertion, an error expected, or a program that has to end well."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from groups import realtime

FOLDER = Path(__file__).parent
FILES = sorted(FOLDER.rglob("*.py"))


def functions(path: Path) -> Iterator[ast.FunctionDef]:
    return (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef))


def called(function: ast.AST) -> set[str]:
    """Names, without what stands before the dot, of all that a function calls."""
    calls = [node.func for node in ast.walk(function) if isinstance(node, ast.Call)]
    return {f.attr for f in calls if isinstance(f, ast.Attribute)} | {
        f.id for f in calls if isinstance(f, ast.Name)
    }


def states(function: ast.FunctionDef) -> bool:
    if any(isinstance(node, ast.Assert) for node in ast.walk(function)):
        return True
    if any(name.startswith("assert_") or name in ("raises", "fail") for name in called(function)):
        return True
    checks = [key for key in ast.walk(function) if isinstance(key, ast.keyword) and key.arg == "check"]
    return any(isinstance(key.value, ast.Constant) and key.value.value is True for key in checks)


@pytest.fixture(scope="module")
def stating() -> set[str]:
    """The functions of the tests that state something, themselves or by what they call."""
    every = [
        function for path in FILES for function in functions(path) if not function.name.startswith("test_")
    ]
    found: set[str] = set()
    while more := {f.name for f in every if f.name not in found and (states(f) or called(f) & found)}:
        found |= more
    return found


@pytest.mark.parametrize("path", [p for p in FILES if p.name.startswith("test_")], ids=lambda p: p.name)
def test_every_test_states_something(path: Path, stating: set[str]) -> None:
    empty = {
        f"{path.relative_to(FOLDER.parent).as_posix()}::{function.name}"
        for function in functions(path)
        if function.name.startswith("test_") and not states(function) and not called(function) & stating
    }
    assert empty == set()


@pytest.mark.parametrize("path", [p for p in FILES if p.name.startswith("test_")], ids=lambda p: p.name)
def test_no_test_compares_a_thing_with_itself_or_an_interval_with_its_own_middle(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Compare):
            continue
        sides = [ast.unparse(side) for side in (node.left, *node.comparators)]
        owned = [side.rpartition(".") for side in sides]
        middle = len({owner for owner, _, _ in owned}) == 1 and [name for *_, name in owned] == [
            "low",
            "value",
            "high",
        ]
        assert not middle, f"{path.name}:{node.lineno} is true by construction"
        calls = any(
            isinstance(inner, ast.Call) for inner in ast.walk(node)
        )  # the same call twice may tell two things
        assert calls or len(set(sides)) == len(sides), (
            f"{path.name}:{node.lineno} compares a thing with itself"
        )


@pytest.mark.parametrize("path", [p for p in FILES if p.name.startswith("test_")], ids=lambda p: p.name)
def test_what_flies_in_real_time_says_so(path: Path) -> None:
    """One worker flies all of it: two companions at once would starve each other."""
    flies = re.search(
        r"\b(Companion|ManInTheMiddle|Scene)\(|conftest import Link|\"companion\", \"run\"", path.read_text()
    )
    assert flies is None or realtime(path) or path.name == "test_tests.py", f"{path.name} has `{flies[0]}`"
