"""An effect of your own: the cable of a tethered quadrotor, which weighs the more the higher it flies.

One Python file in a folder is all it takes; `groundstation effect new NAME` writes such a file to start from. Here the
cable is put into a flight without one, so that the answer is known.
"""

import sys
from dataclasses import replace
from pathlib import Path

import trueflight as tf
from trueflight.models.frames import rotation_matrix

SAMPLES = Path(__file__).parents[1] / "samples" / "rotorpy" / "nothing_hidden"
OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
(OUT / "effects").mkdir(parents=True, exist_ok=True)

(OUT / "effects" / "cable.py").write_text('''"""The weight of the cable that a tethered quadrotor lifts."""

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, weight: Array) -> Motion:
    """`a = -weight h` along world z: the cable hangs straight down, `weight` m/s² for each metre of it."""
    pull = -weight * motion.height
    return motion.with_(force=motion.force + pull[:, None] * motion.rotation[:, 2, :])


EFFECT = Effect(
    name="cable", title="the weight of a tether", stage=Stage.FORCE, formula=formula,
    parameters=(Parameter("weight", "1/s^2", "cable's weight per height, over mass", 0.0, 0.2, 0.0, 5.0),),
    needs=("quaternion", "position", "thrust_command"),
    manoeuvre="slow climbs over the whole length of the cable", citation="a weight hangs down",
    confounded_with=("ground_effect",),
)
''')  # fmt: skip

flight = tf.read(SAMPLES / "identify.parquet").part(slice(0, 4000))
up = rotation_matrix(flight.column("quaternion"))[:, 2, :]  # world z in body axes
pull = -0.3 * flight.column("position")[:, 2:] * up
tethered = replace(flight, name="tethered", specific_force=flight.column("specific_force") + pull)

found = tf.diagnose(tethered, effects=OUT / "effects")
print(found)
print("hidden: 0.3 1/s²; found:", found.interval("cable"))
found.plot("prediction").savefig(OUT / "04_cable.png", dpi=110)
