"""The notebooks run from the first cell to the last, and are committed with what they put out."""

import json
from pathlib import Path
from typing import Any

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def cells(path: Path) -> list[dict[str, Any]]:
    """The code cells of a notebook file."""
    table = json.loads(path.read_text(encoding="utf-8"))
    return [cell for cell in table["cells"] if cell["cell_type"] == "code"]


def executed(name: str, folder: Path) -> str:
    """Run a notebook beside its samples; returns what its last cell put out."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(EXAMPLES / name, as_version=4)
    client = NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": folder}}
    )
    client.execute()
    last = [cell for cell in notebook.cells if cell["cell_type"] == "code"][-1]
    return str(last["outputs"][-1]["data"])


@pytest.mark.parametrize("name", ["own_log.ipynb", "paper.ipynb"])
def test_a_notebook_is_committed_with_its_outputs_and_pictures(name: str) -> None:
    found = cells(EXAMPLES / name)
    assert [cell["execution_count"] for cell in found] == list(range(1, len(found) + 1))
    kinds = [kind for cell in found for output in cell["outputs"] for kind in output.get("data", {})]
    assert "image/png" in kinds
    assert not [o for cell in found for o in cell["outputs"] if o["output_type"] == "error"]


def test_an_own_log_leads_to_the_effect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRUEFLIGHT_SAMPLES", str(EXAMPLES.parent / "samples"))
    assert "thrust_gain.gain 0.83" in executed("own_log.ipynb", tmp_path)


@pytest.mark.long
def test_the_paper_in_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRUEFLIGHT_MINUTES", "5")
    monkeypatch.setenv("TRUEFLIGHT_FOLDER", str(tmp_path))
    assert "image/png" in executed("paper.ipynb", tmp_path)
