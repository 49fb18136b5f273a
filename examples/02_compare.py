"""Model against measurement: how far a model is from a flight, whether exact rotation helps, and where it fails."""

import sys
from pathlib import Path

import trueflight as tf

SAMPLES = Path(__file__).parents[1] / "samples"
OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
OUT.mkdir(parents=True, exist_ok=True)

flight = tf.read(SAMPLES / "rotorpy" / "rotor_drag" / "identify.parquet")
linear = tf.compare(flight, model="linear")  # the hover linearisation, as in the paper
rigid = tf.compare(flight)  # no version in the store yet: exact rotation of the thrust
print(rigid.summary())

for c in (linear, rigid):
    print(f"{c.label:12s} residual {c.rms:.3f} m/s², {c.rms / c.noise_floor:.1f} times the noise floor")
print(rigid.where.summary())

print(tf.side_by_side([flight], models=["linear", None]))
rigid.plot("over_time").savefig(OUT / "02_over_time.png", dpi=110)
rigid.where.plot("maps").savefig(OUT / "02_maps.png", dpi=110)
