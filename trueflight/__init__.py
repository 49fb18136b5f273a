"""Makes a real quadrotor fly like its linear design, and tells its owner why it did not.

`trueflight.models`, `.companion`, `.groundstation` and `.sim_bridge` are the folders of these names beside this one.
"""

import os
from typing import TYPE_CHECKING

# ONNX Runtime's own builds report to their maker over the network, and keep an identifier of the machine, unless this
# is set before it is loaded. Neither a vehicle nor a ground station does that.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__: str
"""The installed version, by git's tags; "unknown" where only the folder is on the path."""

if not TYPE_CHECKING:

    def __getattr__(name: str) -> str:
        if name != "__version__":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib.metadata import PackageNotFoundError, version  # slow, and seldom asked for

        try:
            return version(__name__)
        except PackageNotFoundError:
            return "unknown"
