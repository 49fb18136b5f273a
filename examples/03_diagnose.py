"""Which effect is missing: named, with 95 % intervals, and checked on a flight that was held out of every fit."""

import sys
from pathlib import Path

import trueflight as tf

SAMPLES = Path(__file__).parents[1] / "samples" / "rotorpy" / "rotor_drag"
OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
OUT.mkdir(parents=True, exist_ok=True)

flight, other = tf.read(SAMPLES / "identify.parquet"), tf.read(SAMPLES / "validate.parquet")
found = tf.diagnose(
    flight.part(slice(0, 4000)), validate=other.part(slice(0, 2000))
)  # 40 s and 20 s are enough
print(found.summary())

print("missing:", found.missing)
for name, (low, high) in found.interval("rotor_drag").items():
    print(f"rotor_drag {name}: {found.params[f'rotor_drag.{name}']:.3f} 1/s, 95 % in [{low:.3f}, {high:.3f}]")
print("the simulator had 0.2 1/s")

model = found.model.save(OUT / "store")  # the next version of this vehicle's model
print(model, "on the flight held out:", tf.compare(other, model=model))

found.plot("waterfall").savefig(OUT / "03_waterfall.png", dpi=110)
found.plot("maps").savefig(OUT / "03_maps.png", dpi=110)
found.report(OUT / "report.html")
