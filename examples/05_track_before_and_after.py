"""How far from its linear design a flight was, before and after: mean squared error per axis, as in the paper.

Before, the correction knows nothing; after, it knows the drag that the simulated vehicle has.
"""

import sys
from pathlib import Path

import trueflight as tf

OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
OUT.mkdir(parents=True, exist_ok=True)

TASK = {"speed": 2.5, "height": 0.8}
hidden = "rotor_drag:0.4"

before = tf.simulate(OUT / "before.mcap", trajectory="lemniscate", parameters=TASK, hidden=hidden)
model = tf.add(before, "rotor_drag")
print(model)

correction = tf.export(before, OUT / "correction.onnx", model=model)
after = tf.simulate(
    OUT / "after.mcap", trajectory="lemniscate", parameters=TASK, hidden=hidden, correction=correction
)

was, now = tf.track(before), tf.track(after)
print(was.summary())
for axis, a, b in zip("xyz", was.mse, now.mse, strict=True):
    print(f"{axis}: {a:.2e} -> {b:.2e} m², ÷ {a / b:.0f}")
was.plot().savefig(OUT / "05_before.png", dpi=110)
now.plot().savefig(OUT / "05_after.png", dpi=110)
