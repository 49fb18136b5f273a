"""Thrust is lost in descent near the induced velocity."""

import math

from array_api_compat import array_namespace

from trueflight.models.effect import DESCENT, Array, Effect, Motion, Parameter, Stage
from trueflight.models.vehicle import GRAVITY

AIR_DENSITY = 1.225
"""kg/m³ at sea level."""
CENTRE, WIDTH = 0.9, 0.35
"""Descent speed over hover induced velocity at which most is lost, and the half width of that range."""
WASHED_AWAY = 0.6
"""Horizontal airspeed over induced velocity at which the ring is left behind: the loss is down to a third."""


def formula(motion: Motion, *, loss: Array) -> Motion:
    """`T' = T (1 - loss exp(-((s - 0.9) / 0.35)²) exp(-(m / 0.6)²))`, s and m descent and edgewise speed over `v_h`.

    `v_h = sqrt(m g / (2 rho_air A))`, A the area of all discs, is the hover's induced velocity. The loss peaks in the
    vortex ring state at descents of 0.5 to 1.4 v_h and ends where edgewise flow carries the ring away.
    """
    xp = array_namespace(motion.thrust)
    ahead, left, up = motion.body_velocity
    induced = hover_induced_velocity(motion)
    off = (-up / induced - CENTRE) / WIDTH
    edgewise = (ahead * ahead + left * left) / (WASHED_AWAY * induced) ** 2
    return motion.with_(thrust=motion.thrust * (1.0 - loss * xp.exp(-(off * off) - edgewise)))


def hover_induced_velocity(motion: Motion) -> float:
    """Induced velocity of the rotors in hover by momentum theory, m/s."""
    vehicle = motion.vehicle
    area = max(len(vehicle.rotor_positions), 1) * math.pi * vehicle.rotor_radius**2
    return math.sqrt(vehicle.mass * GRAVITY / (2.0 * AIR_DENSITY * area))


EFFECT = Effect(
    name="vortex_ring",
    title="thrust is lost in descent near the induced velocity",
    stage=Stage.THRUST,
    formula=formula,
    parameters=(
        Parameter("loss", "1", "share of thrust lost where the ring is strongest", 0.0, 0.2, 0.0, 0.8),
    ),
    needs=("quaternion", "velocity", "thrust_command"),
    manoeuvre="vertical descents at half to one and a half times the rotors' induced velocity, with height to recover",
    citation="Leishman, Principles of Helicopter Aerodynamics, sec. 2.13 (rotor in axial descent); "
    "Shetty & Selig 2011 (AIAA 2011-1254; small propellers lose up to a third of their thrust); bump by the authors",
    confounded_with=("axial_inflow", "parasitic_drag"),
    generalises=("axial_inflow",),
    shown_in=DESCENT,
)
