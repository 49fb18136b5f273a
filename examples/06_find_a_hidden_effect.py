"""A simulated vehicle has an effect that was drawn at random and sealed: find it, and only then look at the answer."""

import sys
from pathlib import Path

import trueflight as tf

OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
OUT.mkdir(parents=True, exist_ok=True)

survey = tf.simulate(OUT / "survey.mcap", trajectory="excitation", hidden="random", seed=7)
print(survey)

found = tf.diagnose(survey)
for name in found.missing:
    print(f"found {name}:", found.interval(name))

for name, truth in tf.reveal(survey).items():
    print(f"hidden was {name}:", {parameter: round(value, 4) for parameter, value in truth.items()})
found.plot("waterfall").savefig(OUT / "06_waterfall.png", dpi=110)
