"""Every writer of files on the ground, on a disk that is full and killed at any moment: what was there before stays.

    python tests/faults/writers.py --kills 20 --seed 1

prints one line a writer and exits with 1 where one breaks its promise. A full disk is a limit on the size of files
(RLIMIT_FSIZE), which fails a write in its middle as a full disk does, and needs no rights.
"""

# ruff: noqa: E501 - the path to other tests' files comes first; tables of values are kept in few lines

from __future__ import annotations

import argparse
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from readers import QUAD5, _columns

from trueflight.groundstation.evaluate.survey import write_table
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.writing import write_flight
from trueflight.groundstation.report.page import write_report
from trueflight.groundstation.study.calibration_study import _write as write_study
from trueflight.groundstation.versions.effect_file import write_effect_file
from trueflight.groundstation.versions.store import newest, save, versions
from trueflight.models.database import Collection
from trueflight.models.design import load_design, save_design
from trueflight.models.errors import InputError
from trueflight.models.model import Term, read_model, rigid_body_model
from trueflight.models.record import read_record
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.models.whole_file import write_whole
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.seal import reveal, seal


@dataclass(frozen=True)
class Writer:
    """`write` writes into a folder, again and again; `check` raises where what it left there is not whole."""

    name: str
    write: Callable[[Path], object]
    check: Callable[[Path], object]
    kill: bool = True


def writers(flight_file: Path) -> tuple[Writer, ...]:
    """All of them. Those that write by `write_whole` alone stand for one another."""
    vehicle, design = load_vehicle(QUAD5 / "vehicle.toml"), load_design(QUAD5 / "design.json")
    flight = read_flight(flight_file, vehicle)
    terms = (
        Term("rigid_body", {}),
        Term("rotor_drag", {"x": 0.3, "y": 0.4}, {f"{i:06d}": (0.0, 1.0) for i in range(2000)}),
    )
    model = rigid_body_model(vehicle).with_terms(terms)
    plan = Plan(vehicle, design, trajectory("hover", duration=1.0), (), 1)

    def store(folder: Path) -> None:
        for path in versions(folder, vehicle.name):
            read_model(path)
        newest(folder, vehicle)

    def view(folder: Path) -> None:
        from trueflight.groundstation.views.recording import recording, text

        with recording(folder / "view.rrd", "view", "one") as stream:
            text(stream, "note", "word " * 20000)

    def view_is_whole(folder: Path) -> None:
        assert b"RRF2FOOT" in (folder / "view.rrd").read_bytes()[-12:]

    def fly(folder: Path) -> None:
        (folder / "flown.mcap").unlink(missing_ok=True)
        (folder / "flown.csv").unlink(missing_ok=True)
        record(plan, folder / "flown.mcap", folder / "flown.csv")

    def flown(folder: Path) -> None:
        if (folder / "flown.mcap").exists():
            assert not read_record(folder / "flown.mcap").truncated

    def collect(folder: Path) -> None:
        collection = Collection(folder / "collection", {"seed": 1})
        for number in range(40):
            collection.add(f"{number}.mcap", {"seconds": 1.0, "why": "x" * 200})

    page = "<p>" + "word " * 50000
    return (
        Writer("design", lambda f: save_design(design, f / "d.json"), lambda f: load_design(f / "d.json")),
        Writer("model version", lambda f: save(f, model, None), store),
        Writer("flight as CSV", lambda f: write_flight(flight, f / "a.csv"), lambda f: read_flight(f / "a.csv")),
        Writer("flight as Parquet", lambda f: write_flight(flight, f / "a.parquet"), lambda f: read_flight(f / "a.parquet")),
        Writer("report", lambda f: write_report(f / "r.html", page), lambda f: _same(f / "r.html", page)),
        Writer("study", lambda f: write_study(f / "study.json", page), lambda f: _same(f / "study.json", page)),
        Writer("sealed answer", lambda f: seal((), "quad5", 1, f / "a.sealed"), lambda f: reveal(f / "a.sealed")),
        Writer("collection", collect, lambda f: Collection(f / "collection", {"seed": 1})),
        Writer("exported model", lambda f: write_whole(f / "m.onnx", page.encode(), "the model"),
               lambda f: _same(f / "m.onnx", page)),
        Writer("survey", lambda f: write_table([], f / "survey.parquet"), lambda f: _parquet(f / "survey.parquet")),
        Writer("simulated flight", fly, flown),
        Writer("effect", lambda f: (f / "mine.py").unlink(missing_ok=True) or write_effect_file("mine", page, f),
               lambda f: not (f / "mine.py").exists() or _same(f / "mine.py", page)),
        Writer("recording", view, view_is_whole, kill=False),  # its threads do not outlive a fork
    )  # fmt: skip


def _same(path: Path, text: str) -> None:
    assert path.read_text() == text


def _parquet(path: Path) -> None:
    from pyarrow import parquet

    parquet.read_table(path)


@contextmanager
def full_after(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def full_disk(writer: Writer, folder: Path) -> list[str]:
    """Fill the disk at different bytes of what is written; tells each broken promise."""
    wrong = []
    writer.write(folder)
    before = _contents(folder)
    largest = max(len(data) for data in before.values())
    for size in sorted({0, 1, largest // 3, largest // 2, largest - 1}):
        try:
            with full_after(size):
                writer.write(folder)
            if max((len(data) for data in _contents(folder).values()), default=0) > size:
                wrong.append(f"{writer.name}, full after {size}: wrote all the same")
        except InputError as error:
            if "\n" in str(error):
                wrong.append(f"{writer.name}, full after {size}: more than a line: {error}")
        except Exception as error:  # noqa: BLE001 - told as what is wrong
            wrong.append(f"{writer.name}, full after {size}: {type(error).__name__}: {error}")
        wrong += _broken(writer, folder, f"full after {size}")
        if hidden := [path for path in folder.rglob("*") if path.name.startswith(".")]:
            wrong.append(f"{writer.name}, full after {size}: left {hidden}")
    return wrong


def killed(writer: Writer, folder: Path, draw: random.Random) -> list[str]:
    """Kill it at a random moment of its writing; tells each broken promise."""
    writer.write(folder)
    begun = time.perf_counter()
    writer.write(folder)
    took = time.perf_counter() - begun
    child = os.fork()
    if not child:
        while True:
            writer.write(folder)
    time.sleep(draw.uniform(0.5, 3.5) * took)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return _broken(writer, folder, "killed")


def _broken(writer: Writer, folder: Path, when: str) -> list[str]:
    try:
        writer.check(folder)
    except Exception as error:  # noqa: BLE001 - told as what is wrong
        return [f"{writer.name}, {when}: {type(error).__name__}: {error}"]
    return []


def _contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def run(kills: int, seed: int, progress: Callable[[str, int], None] = lambda name, wrong: None) -> list[str]:
    """Every writer with a full disk, and `kills` times killed; returns each broken promise. Files that a killed writer
    left must be gone after the next one has written."""
    draw, wrong = random.Random(seed), []
    with tempfile.TemporaryDirectory(prefix="writers-") as name:
        flight_file = Path(name) / "whole.csv"
        _write_csv(flight_file)
        for writer in writers(flight_file):
            folder = Path(name) / writer.name.replace(" ", "-")
            folder.mkdir()
            found: list[str] = []
            if writer.kill:
                for _ in range(kills):
                    found += killed(writer, folder, draw)
                writer.write(folder)
                if left := [path for path in folder.rglob(".*.part")]:
                    found.append(
                        f"{writer.name}: {len(left)} unfinished files of killed writers stay: {left[:2]}"
                    )
            found += full_disk(writer, folder)
            progress(writer.name, len(found))
            wrong += found
    return wrong


def _write_csv(path: Path) -> None:
    columns = _columns()
    rows = zip(*columns.values(), strict=True)
    path.write_text(
        "\n".join([",".join(columns), *(",".join(f"{v:.6g}" for v in row) for row in rows)]) + "\n"
    )


def main() -> int:
    """Run alone: one line a writer."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    wrong = run(asked.kills, asked.seed, lambda name, count: print(f"{name:20s} {count} wrong", flush=True))  # noqa: T201
    for line in wrong:
        print(line)  # noqa: T201
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
