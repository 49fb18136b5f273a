"""Draws learning.png of docs/learning.md: a payload and a gust front, learnt while they fly.

python docs/pictures/learning.py      # flies four lemniscates in-process and writes learning.png beside itself
"""

import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
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
from trueflight.sim_bridge.truth.hidden import choose

BEGINS = 10.0
DRAG = "rotor_drag:0.3"
COLOURS = {CORRECTED: "#e8743b", CORRECTED_ADAPTIVE: "#2b6cb0"}
CASES = (  # title, what begins, unit, and by the place in a tick's `learnt`: name, the truth's, where nothing acts
    ("a payload of 10 % picked up", f"thrust_gain:0.909@{BEGINS}", "thrust gain", {0: ("gain", 1.0)}),
    ("a gust front of 5 m/s", f"wind:5@{BEGINS}", "wind (m/s)", {1: ("east", 0.0), 2: ("north", 0.0)}),
)


def main() -> None:
    """Fly and draw; the observer is off, for it would remove the same error."""
    vehicle = load_vehicle(QUAD5)
    design = load_design(Path(QUAD5).with_name("design.json"), vehicle)
    figure, axes = plt.subplots(2, 2, figsize=(9.0, 5.2), sharex=True, layout="constrained")
    with tempfile.TemporaryDirectory() as folder:
        flown = Path(folder) / "excitation.mcap"
        record(Plan(vehicle, design, trajectory("excitation"), choose([DRAG], vehicle, 0), 0), flown)
        flight = read_flight(flown)
        model = add_effect_to(rigid_body_model(vehicle), ["rotor_drag"], [flight], None).model
        onnx = export_onnx(model, flight, adaptive=True)
        for (title, hidden, unit, numbers), (above, below) in zip(CASES, axes.T, strict=True):
            truth = choose([DRAG, hidden], vehicle, 1)
            for controller, colour in COLOURS.items():
                path = Path(folder) / f"{controller}-{unit[:4]}.mcap"
                plan = Plan(
                    vehicle, design, trajectory("lemniscate", speed=2.0), truth, 1, repeat=2, model=onnx,
                    controller=controller, settle=3.0, observer=ObserverLimits(frequency=0.0),
                )  # fmt: skip
                record(plan, path)
                ticks = read_record(path).ticks
                t = ticks["t"]
                off = np.linalg.norm(ticks["position"] - ticks["position_reference"], axis=1)
                above.plot(t, 100.0 * off, color=colour, label=controller, linewidth=1.2)
            for k, (name, before) in numbers.items():
                value, deviation = ticks["learnt"][:, k], ticks["learnt_deviation"][:, k]
                (line,) = below.plot(t, value, label=f"{name}, learnt", linewidth=1.2)
                low, high = value - 1.96 * deviation, value + 1.96 * deviation
                below.fill_between(t, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
                after = truth[1].parameters[name]
                true = [before, before, after, after]
                below.plot([t[0], BEGINS, BEGINS, t[-1]], true, "--", color=line.get_color(), linewidth=0.9)
            above.set(title=title, ylabel="position error (cm)", ylim=(0, None))
            below.set(ylabel=unit, xlabel="time (s); dashed: true; band: 95 %", xlim=(5.0, 22.0))
            for axis in (above, below):
                axis.axvline(BEGINS, color="0.7", linewidth=0.8)
                axis.legend(fontsize=8, frameon=False)
        axes[1, 0].set_ylim(0.88, 1.03)
        axes[1, 1].set_ylim(-6.0, 3.0)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
