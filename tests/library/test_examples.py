"""Every example runs, and finds what is known to be there."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
SAYS = {
    "01_read_and_look": ["velocity", "252 Hz", "fastest 0.65 m/s"],
    "02_compare": ["linear       residual 0.624 m/s²", "+ rigid_body residual 0.315 m/s²", "Where it fails"],
    "03_diagnose": ["missing: ('rotor_drag',)", "<Model v1 + rotor_drag"],
    "04_effect_of_your_own": ["missing cable;"],
    "05_track_before_and_after": ["rotor_drag.x 0.40", "x: 9."],
    "06_find_a_hidden_effect": ["found battery_sag", "hidden was battery_sag: {'exponent': 1.3631}"],
    "07_train_and_export": ["211 parameters", "network.onnx: "],
    "08_gains_and_tube": ["0.3 Hz  horizontal rises in 1.25 s", "the flight never leaves the tube"],
}
"""What each prints. Figures of a fit depend on the machine from the fourth digit on."""


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_an_example_runs_and_finds(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", [str(path), str(tmp_path / "out")])
    monkeypatch.chdir(tmp_path)  # its model store is not ours
    runpy.run_path(str(path), run_name="__main__")
    told = capsys.readouterr().out
    for words in SAYS[path.stem]:
        assert words in told
    pictures = {p.name for p in (tmp_path / "out").glob("*.png")}
    committed = {p.name for p in (EXAMPLES / "pictures").glob(f"{path.stem[:3]}*.png")}
    assert committed == pictures, "copy what it drew to examples/pictures, and look at it"


def test_examples_are_short_and_have_one_idea_each() -> None:
    found = sorted(EXAMPLES.glob("*.py"))
    assert len(found) == len(SAYS) == 8
    assert all(len(path.read_text().splitlines()) < 60 for path in found)
