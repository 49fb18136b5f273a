"""Learning in flight: what changes is found how fast, and what it costs the path, with and without learning.

    python benchmarks/learning_in_flight.py [--seeds 3]

A vehicle with rotor drag is identified and its model exported with --adaptive. Then it flies a lemniscate in the
in-process simulator, where something changes `BEGINS` s after its start, with `corrected` and with
`corrected_adaptive`, each with and without the disturbance observer. Told are medians over the seeds: the RMS of the
position error over the second before the change, over the worst second of the three after it, and over the sixth; what
observer and trim carry 5 s after it (m/s²); what was learnt by then of thrust gain and wind (east, north), with its
standard deviation, and the furthest that each ever was from its deployed value; how learning ended.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from trueflight.companion.law.residual import ObserverLimits
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.versions.several import add_effect_to
from trueflight.models.contract import CORRECTED, CORRECTED_ADAPTIVE
from trueflight.models.design import load_design
from trueflight.models.export import export_onnx
from trueflight.models.model import rigid_body_model
from trueflight.models.record import read_record
from trueflight.models.reference import trajectory
from trueflight.models.shipped import QUAD5
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.battery import BatteryState
from trueflight.sim_bridge.truth.hidden import choose
from trueflight.sim_bridge.truth.sensors import Noise

BEGINS = 10.0
CASES = {
    "payload 10 %": (f"thrust_gain:0.909@{BEGINS}",),
    "gust front 5 m/s": (f"wind:5@{BEGINS}",),
    "propeller nicked": (f"rotor_damage:0.15@{BEGINS}",),
    "nothing": (),
    "accelerometer off": ("accelerometer_bias:0.4",),
    "noise x 5": (),
    "old battery": (),
}


def main() -> None:
    """Fly and tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    seeds = parser.parse_args().seeds
    vehicle = load_vehicle(QUAD5)
    design = load_design(Path(QUAD5).with_name("design.json"), vehicle)
    drag = ["rotor_drag:0.3"]
    path = trajectory("lemniscate", speed=2.0)
    with tempfile.TemporaryDirectory() as folder:
        flown = Path(folder) / "excitation.mcap"
        record(Plan(vehicle, design, trajectory("excitation"), choose(drag, vehicle, 0), 0), flown)
        flight = read_flight(flown)
        model = add_effect_to(rigid_body_model(vehicle), ["rotor_drag"], [flight], None).model
        onnx = export_onnx(model, flight, adaptive=True)
        for name, hidden in CASES.items():
            for observer in (True, False):
                for controller in (CORRECTED, CORRECTED_ADAPTIVE):
                    rows = []
                    for seed in range(1, seeds + 1):
                        plan = Plan(
                            vehicle,
                            design,
                            path,
                            choose([*drag, *hidden], vehicle, seed),
                            seed,
                            repeat=2,
                            model=onnx,
                            controller=controller,
                            settle=3.0,
                        )
                        if not observer:
                            plan = replace(plan, observer=ObserverLimits(frequency=0.0))
                        if name == "noise x 5":
                            plan = replace(plan, noise=Noise(accelerometer=5 * Noise().accelerometer))
                        if name == "old battery":
                            plan = replace(plan, battery=BatteryState(charge=0.6, age=1.5))
                        file = Path(folder) / "one.mcap"
                        file.unlink(missing_ok=True)
                        rows.append((*_figures(record(plan, file).outcome, file),))
                    _tell(name, controller, observer, rows)


def _figures(outcome: str, file: Path) -> tuple[object, ...]:
    ticks = read_record(file).ticks
    t = ticks["t"]
    off = np.linalg.norm(ticks["position"] - ticks["position_reference"], axis=1)

    def rms(start: float) -> float:
        return float(np.sqrt(np.mean(off[(t >= start) & (t < start + 1.0)] ** 2)))

    at = int(np.searchsorted(t, BEGINS + 5.0))
    carried = float(np.linalg.norm(np.mean(ticks["trim"][at - 50 : at + 50], axis=0)))
    worst = max(rms(BEGINS + 0.1 * k) for k in range(1, 21))
    told: list[object] = [outcome, rms(BEGINS - 1.0), worst, rms(BEGINS + 5.0), carried]
    if "learnt" in ticks:
        learnt = ticks["learnt"][:, :3]
        furthest = np.max(np.abs(learnt - learnt[0]), axis=0)
        told += [learnt[at], ticks["learnt_deviation"][at, :3], furthest, ticks["learning"][-1]]
    return tuple(told)


def _tell(name: str, controller: str, observer: bool, rows: list[tuple[object, ...]]) -> None:
    mean = [np.median([row[k] for row in rows]) for k in range(1, 5)]  # type: ignore[arg-type]
    errors = (
        f"error before {mean[0]:.3f}, worst {mean[1]:.3f}, after 5 s {mean[2]:.3f} m, carried {mean[3]:.2f}"
    )
    line = f"{name:18s} {controller:18s} observer {'on ' if observer else 'off'}  {errors}"
    if len(rows[0]) > 5:
        number, deviation, furthest = (
            np.median(np.array([row[k] for row in rows]), axis=0) for k in (5, 6, 7)
        )
        line += "  learnt " + " ".join(f"{a:.3f}±{s:.3f}" for a, s in zip(number, deviation, strict=True))
        line += " furthest " + " ".join(f"{a:.3f}" for a in furthest)
        line += "  " + "; ".join(sorted({str(row[8]) for row in rows}))
    print(line + "  " + "; ".join(sorted({str(row[0]) for row in rows})), flush=True)


if __name__ == "__main__":
    main()
