"""A network for what no effect explains, and one ONNX file that the vehicle can fly with.

It learns what a model leaves over of a flight; here of a vehicle whose drag the model does not know.
"""

import sys
from pathlib import Path

import trueflight as tf

SAMPLES = Path(__file__).parents[1] / "samples" / "rotorpy" / "rotor_drag"
OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
OUT.mkdir(parents=True, exist_ok=True)

flight, other = tf.read(SAMPLES / "identify.parquet"), tf.read(SAMPLES / "validate.parquet")
done = tf.train([flight], layers=(16,), epochs=8, seed=1)
print(done)
print(done.summary())

before, after = tf.compare(other), tf.compare(other, model=done.model)
print(f"a flight it never saw: {before.rms:.3f} -> {after.rms:.3f} m/s², noise floor {after.noise_floor:.3f}")
after.plot("prediction").savefig(OUT / "07_network.png", dpi=110)

path = tf.export(flight, OUT / "network.onnx", model=done.model)
print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB, to be deployed with `groundstation deploy`")
