"""Gains for a vehicle, how their loops close, and the tube in which the stability bound says that it will fly."""

import sys
from pathlib import Path

import trueflight as tf
from trueflight.groundstation.design.linear_design import loops
from trueflight.models.shipped import QUAD5
from trueflight.models.vehicle import load_vehicle

OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
OUT.mkdir(parents=True, exist_ok=True)

vehicle = load_vehicle(QUAD5)
for bandwidth in (0.2, 0.3):
    gains = tf.design(vehicle, bandwidth=bandwidth)
    for loop in loops(gains, vehicle):
        print(
            f"{bandwidth} Hz  {loop.name:10s} rises in {loop.rise_time:.2f} s, overshoot {100 * loop.overshoot:.0f} %, "
            f"phase margin {loop.phase_margin:.0f} deg"
        )

flown = {
    "trajectory": "lemniscate",
    "parameters": {"speed": 2.0},
    "hidden": "rotor_drag:0.3",
    "design": gains,
}
first = tf.simulate(OUT / "first.mcap", **flown, seed=1)
second = tf.simulate(OUT / "second.mcap", **flown, seed=2)

tube = tf.bound(second, earlier=first)  # what disturbed the first flight bounds the second
print(tube)
print(tube.summary())
