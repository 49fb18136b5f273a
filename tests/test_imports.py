"""Who may import what: the rules that keep the companion light and the simulator's truth its own."""

import ast
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
STANDARD = sys.stdlib_module_names
EVERYWHERE = {"numpy", "typer", "rich", "trueflight.models"}

ALLOWED = {
    "models": {"array_api_compat", "mcap", "lz4", "zstandard", "google"},
    "companion": {"trueflight.companion", "mavsdk", "zenoh", "onnxruntime", "mcap", "google"},
    "groundstation": {
        "trueflight.groundstation", "torch", "control", "scipy", "rerun", "pyarrow", "pyulog", "pymavlink", "rosbags",
        "onnx", "onnxruntime", "mcap", "mcap_ros2", "zstandard", "google", "zenoh", "jinja2", "markupsafe",
        "matplotlib", "pandas", "dask", "distributed", "cryptography", "threadpoolctl", "sympy", "starlette", "uvicorn",
        "foxglove",
    },
    "sim_bridge": {
        "trueflight.sim_bridge", "trueflight.companion", "mujoco", "pymavlink", "scipy", "mcap", "google",
        "onnxruntime",
    },
}  # fmt: skip
FITS_OR_EXPORTS = {"models/export.py": {"torch", "onnx"}, "models/export_graph.py": {"torch"}}
"""The modules of models/ that may import torch: they fit, train or export, on the ground."""
OPENS_OR_SIGNS = {
    "models/session.py": {"zenoh"},
    "models/signature.py": {"cryptography"},
    "models/access.py": {"cryptography"},
}
"""The modules of models/ that both ends of Zenoh open their session and judge keys by."""


ROOMS: dict[str, set[str]] = {
    "results": set(),
    "reading": set(),
    "measured": set(),
    "design": set(),
    "operate": set(),
    "export": set(),
    "identify": {"results", "reading", "measured", "design"},
    "evaluate": {"results", "reading", "measured", "design", "identify"},
    "learn": {"measured", "identify", "evaluate"},
    "versions": {"results", "reading", "measured", "identify"},
    "live": {"results", "reading", "operate", "identify"},
    "output": {"results", "reading", "design", "identify", "evaluate", "learn", "versions", "live"},
    "views": {"results", "evaluate", "learn", "live", "output"},
    "report": {"results", "evaluate", "output"},
    "study": {
        "results", "reading", "operate", "identify", "evaluate", "learn", "versions", "output", "views", "report",
    },
    "library": {
        "results", "reading", "measured", "design", "operate", "identify", "evaluate", "learn", "versions", "output",
        "report", "export",
    },
    "workbench": {
        "results", "reading", "design", "identify", "evaluate", "versions", "output", "views", "report", "operate",
    },
    "commands": {
        "results", "reading", "measured", "design", "operate", "identify", "evaluate", "learn", "versions", "output",
        "views", "report", "study", "export", "workbench", "live",
    },
}  # fmt: skip
"""The rooms of groundstation/ from the bottom to the top, and what each may import: only what stands above it here."""


def imports(path: Path) -> set[str]:
    """Full names of the modules that a file imports, at any depth of its code."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; name the package"
            found |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def sources(folder: Path) -> list[Path]:
    """Every file of a folder; a rule over none of them would hold for nothing."""
    found = sorted(folder.rglob("*.py"))
    assert found, f"no Python in {folder}"
    return found


def _owner(name: str) -> str:
    """The library that a module belongs to; of our own, the folder."""
    parts = name.split(".")
    return ".".join(parts[:2]) if parts[0] == "trueflight" else parts[0]


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_a_package_imports_only_what_its_role_allows(package: str) -> None:
    for path in sources(ROOT / package):
        if path.name == "record_pb2.py":
            continue
        allowed = (
            EVERYWHERE
            | ALLOWED[package]
            | (FITS_OR_EXPORTS | OPENS_OR_SIGNS).get(path.relative_to(ROOT).as_posix(), set())
        )
        foreign = {_owner(name) for name in imports(path)} - STANDARD - allowed
        assert not foreign, f"{path.relative_to(ROOT)} imports {sorted(foreign)}"


def modules(folder: str) -> dict[str, Path]:
    """The modules of a folder by their full names."""
    found = {}
    for path in sources(ROOT / folder):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(["trueflight", *(parts[:-1] if parts[-1] == "__init__" else parts)])] = path
    return found


def arrows(folder: str) -> dict[str, set[str]]:
    """Which modules of its own folder each module imports, for types too."""
    known = modules(folder)
    found: dict[str, set[str]] = {}
    for module, path in known.items():
        found[module] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found[module] |= {alias.name for alias in node.names} & set(known)
            elif isinstance(node, ast.ImportFrom):
                named = [f"{node.module}.{alias.name}" for alias in node.names]
                found[module] |= {name if name in known else str(node.module) for name in named} & set(known)
    return found


def test_rooms_import_only_what_stands_above_them() -> None:
    for number, (room, allowed) in enumerate(ROOMS.items()):
        assert allowed <= set(list(ROOMS)[:number]), f"{room}: {allowed} points down in the table of rooms"
    between: dict[tuple[str, str], list[str]] = {}
    for module, seen in arrows("groundstation").items():
        for other in seen:
            one, two = (name.split(".")[2] for name in (module, other))
            if one != two:
                between.setdefault((one, two), []).append(f"{module} imports {other}")
    assert {room for pair in between for room in pair} <= set(ROOMS)
    wrong = [said for (one, two), where in between.items() if two not in ROOMS[one] for said in where]
    counted = f"{len(between)} arrows between {len(ROOMS)} rooms, {sum(map(len, between.values()))} imports"
    assert not wrong, f"{'; '.join(sorted(wrong))} ({counted})"


@pytest.mark.parametrize("folder", sorted(ALLOWED))
def test_no_module_comes_back_to_itself_by_what_it_imports(folder: str) -> None:
    tuple(TopologicalSorter(arrows(folder)).static_order())  # a CycleError names the circle


@pytest.mark.parametrize("package", ["sim_bridge", "companion"])
def test_neither_simulator_nor_companion_sees_the_effects(package: str) -> None:
    forbidden = (
        "trueflight.models.effect",
        "trueflight.models.effects",
        "trueflight.models.model",
        "trueflight.models.prediction",
        "trueflight.models.export",
    )
    for path in sources(ROOT / package):
        seen = {name for name in imports(path) if name.startswith(forbidden)}
        assert not seen, f"{path.relative_to(ROOT)} imports {sorted(seen)}"


def test_the_law_stands_alone_and_is_all_that_the_simulator_sees_of_the_companion() -> None:
    law = "trueflight.companion.law"
    for folder in ("companion/law", "sim_bridge"):
        for path in sources(ROOT / folder):
            seen = {
                n for n in imports(path) if n.startswith("trueflight.companion") and not n.startswith(law)
            }
            assert not seen, f"{path.relative_to(ROOT)} imports {sorted(seen)}"


def test_mavsdk_belongs_to_the_link() -> None:
    """What decides over a flight, and its tests, need no wire."""
    users = {
        path.name for path in (ROOT / "companion").rglob("*.py") if "mavsdk" in map(_owner, imports(path))
    }
    assert users == {"vehicle_link.py", "commands.py"}


def test_groundstation_never_imports_the_simulator() -> None:
    for path in sources(ROOT / "groundstation"):
        assert not any(n.startswith("trueflight.sim_bridge") for n in imports(path)), path


@pytest.mark.parametrize(
    "module",
    [
        "trueflight.companion.cli",
        "trueflight.companion.flight",
        "trueflight.sim_bridge.cli",
        "trueflight.groundstation.commands.app",
    ],
)
def test_a_light_process_loads_no_heavy_library(module: str) -> None:
    import subprocess

    heavy = {"torch", "scipy", "control", "rerun", "pyarrow", "matplotlib", "pandas"}
    if module == "trueflight.companion.flight":
        heavy |= {"mavsdk", "zenoh", "onnxruntime"}  # what decides over a flight needs no wire
    if module == "trueflight.groundstation.commands.app":
        heavy |= {"numpy", "zenoh", "onnxruntime"}  # --help and completion answer at once
    code = f"import sys, {module}; print(sorted({heavy!r} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert out.stdout.strip() == "[]"


def loaded_by(*arguments: str) -> set[str]:
    """The modules that `groundstation` has loaded when it ends."""
    import subprocess

    code = (
        "import sys\n"
        "from trueflight.groundstation.commands.app import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print('loaded', *sys.modules)\n"
    )
    out = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True, cwd=ROOT
    )
    return set(out.stdout.splitlines()[-1].split()[1:])


def test_the_programs_help_loads_no_command() -> None:
    loaded = loaded_by("--help")
    commands = {m for m in loaded if m.startswith("trueflight.groundstation.")}
    assert commands == {f"trueflight.groundstation.commands{m}" for m in ("", ".app", ".tasks", ".choosing")}
    assert not loaded & {"numpy", "pydantic", "trueflight.models.flight"}


SAMPLE = "samples/rotorpy/nothing_hidden/identify.parquet"
NEVER = {
    "torch",
    "control",
    "pandas",
    "scipy.stats",
    "scipy.signal",
    "statsmodels",
    "onnx",
    "zenoh",
    "dask",
    "sympy",
}
"""What no flight is read, compared or diagnosed with."""
DRAWING = {"matplotlib", "rerun"}


@pytest.mark.parametrize("command", ["diagnose", "compare"])
def test_what_cannot_be_read_is_told_before_anything_dear_is_loaded(command: str) -> None:
    assert not loaded_by(command, "nothing.csv") & {*NEVER, *DRAWING, "scipy", "pyarrow", "google.protobuf"}


def test_a_flight_is_diagnosed_and_compared_with_what_that_needs_alone(tmp_path: Path) -> None:
    assert not loaded_by("diagnose", SAMPLE) & {*NEVER, *DRAWING}
    assert not loaded_by("compare", SAMPLE) & {*NEVER, *DRAWING}
    drawn = loaded_by("compare", SAMPLE, "--save", str(tmp_path / "compare.rrd"))
    assert "rerun" in drawn and not drawn & {"torch", "control", "scipy.stats", "onnx", "zenoh"}


def test_a_diagnosis_begins_without_what_it_may_not_need() -> None:
    import subprocess

    dear = {
        "scipy.stats",
        "scipy.signal",
        "scipy.optimize",
        "pandas",
        "pyarrow",
        "torch",
        "control",
        "matplotlib",
    }
    modules = ("evaluate.analysis", "identify.translation", "reading", "output.tables", "output.as_json")
    wanted = ", ".join(f"trueflight.groundstation.{m}" for m in modules)
    code = f"import sys, {wanted}; print(sorted({dear!r} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert out.stdout.strip() == "[]"


def test_a_comparison_is_drawn_without_torch() -> None:
    import subprocess

    code = "import sys, trueflight.groundstation.views; print('torch' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert out.stdout.strip() == "False"


@pytest.mark.parametrize(
    "module",
    [
        "trueflight.companion.law.inference",
        "trueflight.companion.law.model_check",
        "trueflight.companion.inspection",
        "trueflight.groundstation.commands.app",
        "trueflight.models.export",
    ],
)
def test_onnxruntime_tells_nobody_of_what_it_runs(module: str) -> None:
    """Its builds send events to their maker, unless told otherwise before they are loaded."""
    import os
    import subprocess

    clean = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    code = (
        "import sys\n"
        "class Seen:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        import os\n"
        "        if name == 'onnxruntime': print(os.environ.get('ORT_DISABLE_TELEMETRY'))\n"
        "sys.meta_path.insert(0, Seen())\n"
        f"import {module}\nimport onnxruntime\n"
    )
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT, env=clean
    )
    assert out.stdout.split() == ["1"]
