"""Read a log and look at it: what was recorded, as a table for pandas, and where the vehicle went.

A real flight of a Crazyflie, whose columns have names of their own: the mapping beside the file tells which is which.
"""

import sys
from pathlib import Path

import trueflight as tf

SAMPLES = Path(__file__).parents[1] / "samples"
OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
OUT.mkdir(parents=True, exist_ok=True)

flight = tf.read(SAMPLES / "crazyflie" / "crazyswarm2_log201.csv")
print(flight.summary())

table = flight.to_pandas()
print(table[["position_x", "position_y", "position_z", "thrust_command"]].describe().round(3))
print(
    f"fastest {table[['velocity_x', 'velocity_y', 'velocity_z']].pow(2).sum(axis=1).pow(0.5).max():.2f} m/s"
)

flight.write(OUT / "log201.parquet")  # SI units, World ENU, body FLU, the vehicle file beside it
tf.compare(flight).plot("path").savefig(OUT / "01_path.png", dpi=110)
