"""The fault campaign: real processes on loopback, in real time, every promise of docs/safety.md tried many times.

    python tests/faults/campaign.py                       # long: hours rather than minutes
    python tests/faults/campaign.py --scale 0.1           # a tenth of it
    python tests/faults/campaign.py --only silences,kills --save rows.json
    python tests/faults/campaign.py --show rows.json      # the table again, without flying

Each part prints its rows when it is done, in the end all as one table (Markdown where the output is no terminal).
Exit code 1 where a promise was broken. A busy machine is late: look at the load that is printed before you believe it.
"""

from __future__ import annotations

import argparse
import os
import platform
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "companion"))

from astray import astray
from floods import floods, starved
from outsiders import files, latency, networks
from promise import Row, load, markdown, on_screen, save
from rich.console import Console
from silences import kills, silences

Part = Callable[[Path, argparse.Namespace], Iterator[Row]]


def scaled(count: float, scale: float) -> int:
    """`count` of something in a campaign of another length; at least one."""
    return max(1, round(count * scale))


PARTS: dict[str, tuple[str, Part]] = {
    "silences": (
        "Silence: hangs, takeovers, lost links",
        lambda folder, a: silences(folder, scaled(10, a.scale), a.seed),
    ),
    "kills": ("Killed in flight", lambda folder, a: kills(folder, scaled(20, a.scale), a.seed)),
    "astray": ("Odometry and sensors that lie", lambda folder, a: astray(folder, scaled(6, a.scale))),
    "floods": ("Floods in flight", lambda folder, a: floods(folder, scaled(1e5, a.scale), a.seed)),
    "starved": ("Starved in flight", lambda folder, a: starved(folder, max(5.0, 30.0 * a.scale))),
    "files": (
        "Damaged files",
        lambda folder, a: files(
            scaled(1e5, a.scale), scaled(20, a.scale), a.seed, 4.0 * 3600.0 * a.scale + 600.0
        ),
    ),
    "networks": ("Hostile networks, keys in use", lambda folder, a: networks(folder, scaled(10, a.scale))),
    "latency": ("Latency", lambda folder, a: latency(a.before, scaled(10, a.scale))),
}


def flown(name: str, asked: argparse.Namespace, console: Console) -> list[Row]:
    """The rows of one part; what it cannot do is a broken promise as well."""
    title, part = PARTS[name]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix=f"campaign-{name}-") as folder:
        try:
            for row in part(Path(folder), asked):
                rows.append(row)
                if asked.save:
                    save(asked.save, {title: rows})
                console.print(
                    f"{time.strftime('%H:%M:%S')} load {os.getloadavg()[0]:.1f}  {' | '.join(row.cells)}"
                )
        except Exception as error:  # noqa: BLE001 - the other parts are flown nevertheless
            console.print("".join(traceback.format_exception(error)), markup=False)
            rows.append(
                Row(f"{title}: went on", 1, "to its end", str(error)[:300] or type(error).__name__, False)
            )
    return rows


def machine() -> str:
    """On what, under what load."""
    model = next(
        (
            x.split(":")[1].strip()
            for x in Path("/proc/cpuinfo").read_text().splitlines()
            if "model name" in x
        ),
        "",
    )
    load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
    python = platform.python_version()
    return f"{os.cpu_count()} processors ({model or platform.machine()}), Python {python}, load {load}"


def show(parts: dict[str, Sequence[Row]], console: Console) -> int:
    """Print the table; 1 where a promise was broken."""
    if console.is_terminal:
        console.print(on_screen(parts))
    else:
        sys.stdout.write(markdown(parts))
    broken = [row for rows in parts.values() for row in rows if not row.kept]
    console.print(f"{sum(map(len, parts.values()))} promises, {len(broken)} broken")
    return int(bool(broken))


def main() -> int:
    """The command line; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scale", type=float, default=1.0, help="share of the long campaign (default 1)")
    parser.add_argument("--only", default=",".join(PARTS), help=f"parts, with commas: {','.join(PARTS)}")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--before", type=Path, default=None, help="checkout of an earlier version, to compare latency"
    )
    parser.add_argument(
        "--save", type=Path, default=None, help="JSON file for the rows; parts that it has stay"
    )
    parser.add_argument("--show", type=Path, default=None, help="fly nothing, print the rows of this file")
    asked = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # what was started is ended
    console, log = Console(), Console(stderr=True, highlight=False, soft_wrap=True)
    if asked.show:
        return show(load(asked.show), console)
    names = asked.only.split(",")
    if unknown := [name for name in names if name not in PARTS]:
        parser.error(f"unknown part {unknown[0]}; known: {', '.join(PARTS)}")
    log.print(machine())
    parts: dict[str, Sequence[Row]] = {}
    for name in names:
        title = PARTS[name][0]
        log.print(f"{time.strftime('%H:%M:%S')} {title}", style="bold")
        parts[title] = flown(name, asked, log)
        if asked.save:
            save(asked.save, {title: parts[title]})
    log.print(machine())
    return show(parts, console)


if __name__ == "__main__":
    sys.exit(main())
