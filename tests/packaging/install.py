"""Builds sdist and wheel, installs the wheel in a new environment beside foreign packages of our folders' names, and
diagnoses a flight there. `make wheel-test` runs it; exit code 1 and a traceback where something is missing.

The heavy libraries come from the environment that runs this; trueflight itself from the wheel alone.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("models", "companion", "groundstation", "sim_bridge")
SAMPLE = ROOT / "samples" / "crazyflie"


def told(*words: object, cwd: Path, **environment: str) -> str:
    """Standard output of a program that must succeed; no setting of this process's Python reaches it."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        list(map(str, words)), cwd=cwd, env=clean | environment, text=True, capture_output=True
    )
    assert done.returncode == 0, f"{' '.join(map(str, words))}\n{done.stdout[-2000:]}{done.stderr[-4000:]}"
    return done.stdout


def checkout(target: Path) -> None:
    """This tree as a clone with what is not yet committed, so that nothing built earlier is in the way."""
    told("git", "clone", "--quiet", ROOT, target, cwd=ROOT)
    changed = told("git", "diff", "--name-only", "-z", "HEAD", cwd=ROOT)
    changed += told("git", "ls-files", "-z", "--others", "--exclude-standard", cwd=ROOT)
    for name in changed.split("\0")[:-1]:
        source, copy = ROOT / name, target / name
        copy.unlink(missing_ok=True)
        if source.exists() or source.is_symlink():
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, copy, follow_symlinks=False)


def build(source: Path, kind: str, into: Path) -> Path:
    """Build with the tools of this environment: no network."""
    told(
        *(sys.executable, "-m", "build", "--no-isolation", f"--{kind}", "--outdir", into, source), cwd=source
    )
    (made,) = into.iterdir()
    return made


def names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def check_contents(wheel: Path, sdist: Path, folder: Path, checked_out: Path) -> None:
    """The wheel is the package and its metadata; the sdist has no more, and makes the same wheel."""
    version = wheel.name.split("-")[1]
    inside = names(wheel)
    package = {name for name in inside if name.startswith("trueflight/")}
    metadata = {name for name in inside if name.startswith(f"trueflight-{version}.dist-info/")}
    assert inside == package | metadata, inside - package - metadata
    files = told(
        "git", "ls-files", "--cached", "--others", "--exclude-standard", *FOLDERS, cwd=checked_out
    ).split()
    here = {f"trueflight/{name}" for name in files if (checked_out / name).exists()}
    here |= {"trueflight/__init__.py", "trueflight/py.typed"}
    assert package == here, package ^ here

    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    top = {path.name for path in unpacked.iterdir()}
    generated = {"PKG-INFO", "setup.cfg", "trueflight.egg-info"}
    assert top == {"trueflight", "pyproject.toml", "README.md", "LICENSE", *generated}, top
    assert not any(path.is_symlink() for path in unpacked.rglob("*"))
    again = build(unpacked, "wheel", folder / "again")
    assert again.name == wheel.name and names(again) == inside, names(again) ^ inside


def foreign_wheel(folder: Path) -> Path:
    """Another project's wheel, with packages of our folders' names."""
    path = folder / "foreign-1.0-py3-none-any.whl"
    info = "foreign-1.0.dist-info"
    files = {f"{name}/__init__.py": f"WHOSE = 'foreign {name}'\n" for name in FOLDERS}
    files[f"{info}/METADATA"] = "Metadata-Version: 2.1\nName: foreign\nVersion: 1.0\n"
    files[f"{info}/WHEEL"] = (
        "Wheel-Version: 1.0\nGenerator: by hand\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    )
    files[f"{info}/RECORD"] = "".join(f"{name},,\n" for name in [*files, f"{info}/RECORD"])
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return path


class Environment:
    """A new virtual environment that sees the libraries of this one, and none of its trueflight."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        told(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder.parent)
        self.python = folder / "bin" / "python"
        self.packages = Path(
            told(
                self.python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder
            ).strip()
        )
        # A path from a .pth file adds a folder of packages, not what its own .pth files add: no editable install.
        (self.packages / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")

    def pip(self, *words: object) -> None:
        """Run this environment's pip on the new one."""
        told(
            *(sys.executable, "-m", "pip", "--python", self.python, "--disable-pip-version-check"),
            *words,
            cwd=self.folder,
        )

    def run(self, *words: object, cwd: Path) -> str:
        """Run Python with `cwd` first on its path, as a notebook or `python -m` has it."""
        return told(self.python, *words, cwd=cwd, PYTHONPATH=str(cwd))


IMPORTS = """
import importlib.metadata, json, companion, models, models.own, sys
import trueflight, trueflight.models.flight, trueflight.companion.law.control
ours = {n: m.__file__ for n, m in sys.modules.items() if n.startswith("trueflight") and getattr(m, "__file__", None)}
print(json.dumps({"ours": ours, "version": trueflight.__version__, "foreign": [models.__file__, companion.__file__],
                  "installed": importlib.metadata.version("trueflight"), "own": models.own.ANSWER}))
"""

REAL_FLIGHTS = """
from trueflight.groundstation.commands.demo import show_real_flights
assert not show_real_flights()
"""


def check_beside_foreign_folders(environment: Environment, work: Path, version: str) -> None:
    """In a folder with its own `models/` and `companion/`: both are importable, and a flight is diagnosed."""
    for name in ("models", "companion"):
        (work / name).mkdir(parents=True)
        (work / name / "__init__.py").write_text("")
    (work / "models" / "own.py").write_text("ANSWER = 42\n")
    seen = json.loads(environment.run("-c", IMPORTS, cwd=work))
    strangers = [
        file for file in seen["ours"].values() if not Path(file).is_relative_to(environment.packages)
    ]
    assert not strangers, strangers
    assert seen["version"] == seen["installed"] == version, seen
    assert seen["own"] == 42 and all(Path(file).is_relative_to(work) for file in seen["foreign"]), seen

    for path in SAMPLE.glob("crazyswarm2*"):
        if "log44" in path.name or path.suffix == ".toml":
            shutil.copy2(path, work)
    programs = environment.python.parent
    answer = json.loads(
        environment.run(programs / "groundstation", "diagnose", "crazyswarm2_log44.csv", "--json", cwd=work)
    )
    assert [e["name"] for e in answer["effects"] if e["verdict"] == "missing"], answer
    quad5 = environment.packages / "trueflight" / "models" / "vehicles" / "quad5" / "vehicle.toml"
    fly = (programs / "sim-bridge", "fly", "--trajectory", "hover", "--set", "duration=1", "--json")
    flown = json.loads(
        environment.run(*fly, "--vehicle", quad5, "--hidden", "wind", "-o", "f.mcap", cwd=work)
    )
    assert flown["outcome"] == "finished", flown
    environment.run(programs / "companion", "--help", cwd=work)
    said = environment.run("-c", REAL_FLIGHTS, cwd=work)
    assert said.startswith("No real flights: samples/crazyflie") and said.count("\n") == 1, said


def check_uninstalling(environment: Environment, wheel: Path, foreign: Path) -> None:
    """Neither we nor a foreign package of our folders' names lose a file when the other one goes."""

    def files() -> set[Path]:
        return {
            p
            for p in environment.packages.rglob("*")
            if p.is_file() and "__pycache__" not in p.parts and p.suffix != ".pyc"
        }

    before = files()
    environment.pip("install", "--quiet", "--no-deps", foreign)
    theirs = files() - before
    assert {f"{name}/__init__.py" for name in FOLDERS} <= {
        p.relative_to(environment.packages).as_posix() for p in theirs
    }
    environment.pip("uninstall", "--quiet", "--yes", "trueflight")
    left = files()
    assert theirs <= left and not any("trueflight" in p.as_posix().split("site-packages")[1] for p in left)
    environment.pip("install", "--quiet", "--no-deps", wheel)
    environment.pip("uninstall", "--quiet", "--yes", "foreign")
    assert files() == before, files() ^ before


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="trueflight-wheel-") as name:
        folder = Path(name).resolve()
        checkout(folder / "checkout")
        sdist = build(folder / "checkout", "sdist", folder / "sdist")
        wheel = build(folder / "checkout", "wheel", folder / "wheel")
        check_contents(wheel, sdist, folder, folder / "checkout")
        environment = Environment(folder / "environment")
        environment.pip("install", "--quiet", "--no-deps", wheel)
        check_beside_foreign_folders(environment, folder / "work", wheel.name.split("-")[1])
        check_uninstalling(environment, wheel, foreign_wheel(folder))
        sys.stdout.write(f"{wheel.name}: {len(names(wheel))} files; built, installed, flown and removed\n")


if __name__ == "__main__":
    main()
