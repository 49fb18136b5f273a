"""Makes a real quadrotor fly like its linear design, and tells its owner why it did not.

    import trueflight as tf

    flight = tf.read("log.ulg")
    found = tf.diagnose(flight)
    print(found.summary())

What `tf` offers is `trueflight.groundstation.library`, loaded when it is first asked for: the companion imports this
package too, and must stay light. `trueflight.models`, `.companion`, `.groundstation` and `.sim_bridge` are the folders
of these names beside this one.
"""

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trueflight.groundstation.library import *  # noqa: F403

# ONNX Runtime's own builds report to their maker over the network, and keep an identifier of the machine, unless this
# is set before it is loaded. Neither a vehicle nor a ground station does that.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__: str
"""The installed version, by git's tags; "unknown" where only the folder is on the path."""

__all__ = [  # noqa: F405 (loaded by __getattr__)
    "Comparison",
    "Design",
    "Diagnosis",
    "Effect",
    "Flight",
    "InputError",
    "Model",
    "SideBySide",
    "Summary",
    "Tracking",
    "Training",
    "Tube",
    "Vehicle",
    "WhereItFails",
    "add",
    "bound",
    "compare",
    "design",
    "diagnose",
    "effects",
    "export",
    "read",
    "read_all",
    "report",
    "reveal",
    "side_by_side",
    "simulate",
    "simulate_many",
    "track",
    "train",
    "where",
]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name in __all__:
            from trueflight.groundstation import library

            return getattr(library, name)
        if name != "__version__":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib.metadata import PackageNotFoundError, version  # slow, and seldom asked for

        try:
            return version(__name__)
        except PackageNotFoundError:
            return "unknown"

    def __dir__() -> list[str]:
        return sorted({*__all__, "__version__", *(n for n in globals() if n.startswith("__"))})
