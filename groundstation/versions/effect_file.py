"""An effect of the user's own as a file: the one place that writes it."""

from __future__ import annotations

import re
from pathlib import Path

from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.whole_file import write_whole

TEMPLATE = '''"""NAME: say in one line what it does to the vehicle."""

# This file is all that trueflight knows of your effect. Ranking, fit, intervals, plots and ONNX export take it
# from here: groundstation diagnose FLIGHT --effects DIR, where DIR is the folder of this file.
# It works as it stands, with the weight of a tether as an example: put your own physics in its place.

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, pull: Array) -> Motion:
    """`a = -pull h z`, world z, with the height h of a tether that hangs from the vehicle."""
    # What `motion` holds, N samples, SI units, body FLU, heading frame = world turned by yaw:
    #   command, thrust (N,)    thrust over mass, as commanded and as it acts, m/s²
    #   force (N, 3)            other forces over mass, body axes, m/s²
    #   reading (N, 3)          what the accelerometer adds, body axes, m/s²
    #   rotation (N, 3, 3)      body to heading frame; rotation[:, 2, :] is world z in body axes
    #   body_velocity           three (N,): velocity relative to the air along the body's axes, m/s
    #   height, voltage (N,)    above ground, m; of the battery, V
    #   body_rate, body_acceleration (N, 3), rotor_thrust, rotor_speed (N, 4)    for effects on the rotation
    #   vehicle                 mass, rotor_radius, rotor_positions, ... of vehicle.toml
    # Use functions that numpy and torch share (xp.sqrt, xp.exp, xp.clip, xp.stack), no `if` on values and no loop
    # over samples: the same function is fitted, predicts, and is exported.
    xp = array_namespace(motion.thrust)
    up = motion.rotation[:, 2, :]
    size = -pull * motion.height
    force = xp.stack([size * up[:, 0], size * up[:, 1], size * up[:, 2]], axis=-1)
    # Return a changed motion; never write into its arrays.
    return motion.with_(force=motion.force + force)


EFFECT = Effect(
    name="NAME",
    title="weight of a tether grows with height",
    # When it acts: COMMAND (history of the command), THRUST (its magnitude), AIR (the air's velocity), FORCE (other
    # forces), SENSOR (the reading), TORQUE (on the rotation).
    stage=Stage.FORCE,
    formula=formula,
    # Name, unit, meaning, value without effect, a size that matters in flight, plausible range. The typical size
    # decides whether a flight could have shown the effect; a value outside the range is never called missing.
    # belongs_to=FLIGHT (from trueflight.models.effect) for a number that is each flight's own, as wind is.
    parameters=(Parameter("pull", "1/s^2", "weight over mass and height", 0.0, 0.1, 0.0, 2.0),),
    # Columns of a flight that the formula reads: quaternion, position, velocity, thrust_command, battery_voltage,
    # angular_velocity, specific_force, rotor_speed, ...
    needs=("quaternion", "position", "thrust_command"),
    # What to fly to see it, and what it is easily taken for.
    manoeuvre="slow climbs and descents between 0.5 and 5 m, with a hover at each end",
    citation="weight of the hanging length of a tether: mass per length times height times gravity",
    confounded_with=("thrust_gain", "ground_effect", "battery_sag"),
    # exports=False for an effect with memory: a correction on the vehicle is a static map of features.
    # acts_through=("rotor_drag",) for one that acts only through another; docs/effects.md has the rest.
)
'''


def write_effect_file(name: str, source: str, folder: Path) -> Path:
    """Write `source` of effect `name` as `folder`/`name`.py.

    Raises `InputError` for a name that is none or taken, and where the file exists or cannot be written.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise InputError(f"'{name}' is no name for an effect; use lower-case letters, digits and underscores")
    if name in catalogue():
        raise InputError(f"an effect named '{name}' exists already; choose another name")
    path = folder / f"{name}.py"
    if path.exists():
        raise InputError(f"{path} exists already; choose another name or folder")
    write_whole(path, source, "the effect", "choose another folder", new=True)
    return path


def write_template(name: str, folder: Path) -> Path:
    """Write the template of effect `name` into `folder`; raises as `write_effect_file`."""
    return write_effect_file(name, TEMPLATE.replace("NAME", name), folder)
