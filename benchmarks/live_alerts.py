"""How often `monitor` tells of a change that was none, and how long after a change it tells of it.

python benchmarks/live_alerts.py -o /tmp/live-alerts            # 36 flights of two minutes; half an hour of one core
python benchmarks/live_alerts.py -o /tmp/live-alerts --flights 12 --kinds static nothing

Seeded flights of two minutes in the in-process simulator, in which nothing is hidden, one to three effects are (never
changing), or something changes after about a minute: a payload is dropped, a rotor weakens, the wind comes up. Each is
looked at every other second over its last 40 s by what the monitor looks with (`identify.live`), every fifth look a
thorough one, and told as the monitor tells (`live.said`). What is told before anything changed, or of another moment,
is a false alert. Flights are kept in the folder, and not flown again; the table is printed of all that is there.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import time
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

from trueflight.groundstation.identify.live import Look, look
from trueflight.groundstation.live.said import Said, follow
from trueflight.groundstation.reading.flight_file import read_flight
from trueflight.models.design import load_design
from trueflight.models.errors import InputError
from trueflight.models.model import rigid_body_model
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.hidden import Hidden, choose

VEHICLE = Path(__file__).parents[1] / "models" / "vehicles" / "quad5" / "vehicle.toml"
FLOWN: tuple[tuple[str, dict[str, float]], ...] = (
    ("lemniscate", {}), ("excitation", {"height": 2.5}), ("circle", {}), ("steps", {}), ("scenario", {}),
    ("hover", {"duration": 60.0}),
)  # fmt: skip
KINDS = {
    "nothing": "nothing hidden",
    "static": "one to three effects hidden",
    "drop": "8 to 15 % of the mass dropped",
    "rotor": "one rotor 8 to 16 % weaker",
    "wind": "wind comes up",
}
LENGTH, WINDOW, EVERY, FIRST, THOROUGH = 120.0, 40.0, 2.0, 10.0, 5
"""s: of a flight, looked at, between looks, before the first look; and of how many looks one is thorough."""
AT = 2.0
"""s from the moment of a change within which an alert is of that change."""


def plan(kind: str, seed: int) -> tuple[float, Plan]:
    """A flight of a kind, and when something changes in it, s."""
    draw = random.Random(f"live {kind} {seed}")
    believed = load_vehicle(VEHICLE)
    name, parameters = FLOWN[seed % len(FLOWN)]
    path = trajectory(name, **parameters)
    at = draw.uniform(50.0, 70.0)
    hidden: tuple[Hidden, ...] = ()
    if kind == "static":
        hidden = choose(["any"], believed, seed, draw.randint(1, 3))
    elif kind == "drop":
        load = draw.uniform(0.08, 0.15)
        hidden = tuple(
            Hidden("payload", {"mass_fraction": share, "time": t}) for share, t in ((load, 0.0), (0.0, at))
        )
    elif kind == "rotor":
        hidden = choose([f"rotor_damage@{at:.2f}"], believed, seed)
    elif kind == "wind":
        hidden = choose(["rotor_drag", f"wind@{at:.2f}"], believed, seed)
    design = load_design(VEHICLE.with_name("design.json"), believed)
    repeat = math.ceil(LENGTH / (path.duration + 1.0))
    return at, Plan(believed, design, path, hidden, seed, repeat=repeat, rotor_speeds=bool(seed % 2))


def watched(kind: str, seed: int, folder: Path) -> dict[str, Any]:
    """One flight flown and looked at: what was told, and when."""
    at, planned = plan(kind, seed)
    file = folder / f"{kind}-{seed}.mcap"
    file.unlink(missing_ok=True)
    flown = record(planned, file)
    flight = read_flight(file)
    base = rigid_body_model(flight.vehicle)
    before: Look | None = None
    alerts, told, costs, count = (), [], [], 0
    stop = float(flight.t[0]) + FIRST
    while stop < min(float(flight.t[-1]), LENGTH + 5.0):
        window = flight.part((flight.t > stop - WINDOW) & (flight.t <= stop))
        begun = time.process_time()
        try:
            before = look(window, base, before, count % THOROUGH == 0)
        except InputError as error:
            said = Said("", 1, float(window.t[0]), stop, 0.0, error=str(error))
        else:
            count += 1
            said = Said("", 1, float(window.t[0]), stop, 0.0, before.thorough, before.diagnosis.effects)
            costs.append(time.process_time() - begun)
        alerts, news = follow(alerts, said)
        told += [{**asdict(alert), "when": stop} for alert in news]
        stop += EVERY
    file.unlink()
    return {
        "kind": kind, "seed": seed, "trajectory": planned.trajectory.name, "at": at, "touching": flown.touching,
        "hidden": [h.name for h in planned.hidden], "seconds": min(flight.duration, LENGTH + 5.0), "told": told,
        "costs": costs,
    }  # fmt: skip


def table(flights: list[dict[str, Any]]) -> str:
    """False alerts an hour, changes told, how long after, and what a look costs; a row a kind."""
    rows = ["kind | flights | minutes | false alerts | changes told | s after, median (range) | named"]
    hours, false_of_all = 0.0, 0
    for kind, words in KINDS.items():
        own = [f for f in flights if f["kind"] == kind]
        if not own:
            continue
        changing = kind not in ("nothing", "static")
        wrong, after, named = 0, [], []
        for f in own:
            new = [a for a in f["told"] if not a["taken_back"]]
            true = [a for a in new if changing and a["low"] - AT <= f["at"] <= a["high"] + AT]
            wrong += len(new) - len(true)
            after += [true[0]["when"] - f["at"]] if true else []
            named += [true[0]["effect"]] if true else []
        minutes = sum(f["seconds"] for f in own) / 60.0
        hours, false_of_all = hours + minutes / 60.0, false_of_all + wrong
        late = f"{median(after):.1f} ({min(after):.1f} to {max(after):.1f})" if after else ""
        names = ", ".join(f"{named.count(n)} {n}" for n in dict.fromkeys(named))
        found = f"{len(after)} of {len(own)}" if changing else ""
        rows.append(f"{words} | {len(own)} | {minutes:.0f} | {wrong} | {found} | {late} | {names}")
    costs = sorted(c for f in flights for c in f["costs"])
    rows.append(f"all: {false_of_all} false alerts in {hours:.2f} h")
    rows.append(
        f"a look: {median(costs):.2f} s of processor time in the median, {costs[int(0.95 * len(costs))]:.2f} s "
        f"for 95 %, {costs[-1]:.1f} s at most"
    )
    return "\n".join(rows)


def main() -> None:
    """Fly and look at what is not in the folder yet, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--flights", type=int, default=6, help="of each kind; twice as many of `static`")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    asked = parser.parse_args()
    os.nice(10)
    asked.output.mkdir(parents=True, exist_ok=True)
    for kind in asked.kinds:
        for seed in range(asked.flights * (2 if kind == "static" else 1)):
            done = asked.output / f"{kind}-{seed}.json"
            if not done.exists():
                done.write_text(json.dumps(watched(kind, seed, asked.output)), encoding="utf-8")
    print(table([json.loads(file.read_text()) for file in sorted(asked.output.glob("*.json"))]))


if __name__ == "__main__":
    main()
