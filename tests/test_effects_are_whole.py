"""An effect is whole in its file: nothing outside `models/effects/` decides by an effect's name."""

import ast
from pathlib import Path

import pytest

from trueflight.models.effects import catalogue

ROOT = Path(__file__).parent.parent
SCENARIOS = {
    ("groundstation/study/reproduce.py", "wind"),
    ("groundstation/study/controllers.py", "wind"),
    ("groundstation/study/disturbances.py", "wind"),
}
"""The name of an experiment, which is what its flights are flown in."""


def docstrings(tree: ast.AST) -> set[ast.AST]:
    """The strings that are documentation: those that stand as a statement."""
    return {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}


@pytest.mark.parametrize("folder", ["models", "groundstation", "companion"])
def test_no_code_outside_its_file_knows_an_effect_by_name(folder: str) -> None:
    names = set(catalogue())
    for path in sorted((ROOT / folder).rglob("*.py")):
        told = path.relative_to(ROOT).as_posix()
        if told.startswith("models/effects/"):
            continue
        tree = ast.parse(path.read_text())
        prose = docstrings(tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and node.value in names and node not in prose:
                assert (told, node.value) in SCENARIOS, f"{told}:{node.lineno} knows '{node.value}' by name"
            if isinstance(node, ast.ImportFrom | ast.Import):
                modules = [a.name for a in node.names] + [getattr(node, "module", None) or ""]
                assert not any(m.startswith("trueflight.models.effects.") for m in modules), (
                    f"{told}:{node.lineno}"
                )
