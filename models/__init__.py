"""What the processes agree on: vehicle, frames, references, flights, effects, models, records, contracts."""

import os

# ONNX Runtime's own builds report to their maker over the network, and keep an identifier of the machine, unless this
# is set before it is loaded. Neither a vehicle nor a ground station does that.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
