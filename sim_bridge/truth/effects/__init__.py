"""The effects that the simulator can hide, one file each, by the project's standard names.

Add one by a file with an `EFFECT` and its name at the end of `_NAMES`.
"""

from importlib import import_module

from trueflight.sim_bridge.truth.effect import TruthEffect

_NAMES = (
    "thrust_gain",
    "thrust_curve",
    "battery_sag",
    "motor_lag",
    "transport_delay",
    "rotor_drag",
    "parasitic_drag",
    "ground_effect",
    "wind",
    "accelerometer_bias",
    "estimator_delay",
    "payload",
    "translational_lift",
    "ceiling_effect",
    "vortex_ring",
    "thrust_misalignment",
    "imu_lever_arm",
    "com_offset",
    "rotor_damage",
    "rate_loop_lag",
    "gyroscopic",
    "external_force",
    "external_torque",
    "periodic_torque",
    "gusts",
    "inertia",
)
"""In the order that draws go by: a seed hides for ever what it hid, so that a new effect comes last."""

EFFECTS: dict[str, TruthEffect] = {name: import_module(f"{__name__}.{name}").EFFECT for name in _NAMES}
