"""Makes a real quadrotor fly like its linear design, and tells its owner why it did not.

`trueflight.models`, `.companion`, `.groundstation` and `.sim_bridge` are the folders of these names beside this one.
"""

import os

# ONNX Runtime's own builds report to their maker over the network, and keep an identifier of the machine, unless this
# is set before it is loaded. Neither a vehicle nor a ground station does that.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
