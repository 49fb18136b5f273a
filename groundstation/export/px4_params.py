"""PX4: a `.params` file that QGroundControl loads, for the vehicle (`px4`) or for PX4's own simulator (`px4-sih`).

PX4's body is FRD, so y and z of a vehicle file change sign; a rotor's `KM` is above 0 where it turns counter-clockwise
seen from above, as a vehicle file's direction is. QGroundControl reads lines of vehicle, component, name, value and
MAVLink type (6 a whole number, 9 a real one), with tabs between and `#` before remarks.

Sources, PX4 1.17: `FunctionMotors::updateValues` (thrust = f x² + (1 - f) x of a motor signal x, f is THR_MDL_FAC),
`Ekf::fuseDrag` (-0.5 rho v |v| / EKF2_BCOEF - v EKF2_MCOEF), `Sih::generate_force_and_torques` (SIH_T_MAX u a rotor,
-SIH_KDV v, first order in u), `ActuatorEffectivenessRotors` (CA_ROTOR*).
"""

from __future__ import annotations

from functools import partial

import numpy as np

from trueflight.groundstation.export.target import (
    AIR_DENSITY,
    NO_LAG,
    ROUGHLY,
    WHOLE,
    Holding,
    Known,
    Rotors,
    Target,
    Written,
    airframe_of,
    header,
    hover_command,
    lines_of,
    moments,
    rotors_of,
    told,
)
from trueflight.groundstation.export.words import one_line
from trueflight.models.airframe import Airframe
from trueflight.models.errors import InputError
from trueflight.models.model import Model

_PX4_LENGTH = 0.05
"""m, PX4's own default of CA_ROTOR*_KM; it weighs yaw against itself alone, for PX4 scales each axis."""
_THRUST_COEFFICIENT = 6.5
"""PX4's own default of CA_ROTOR*_CT; only its ratio between rotors acts."""
_LARGEST_BALLISTIC = 200.0
"""kg/m², the limit of EKF2_BCOEF_*: a frame that drags less has none that EKF2 could hold."""
_STRAIGHT = 0.01
"""Of full thrust: a curve that keeps as near to PX4's is held whole."""
_QUAD_X = ((1, -1, 1), (-1, 1, 1), (1, 1, -1), (-1, -1, -1))
"""Sign of x and y (FLU) and direction of each rotor in SIH, in PX4's order."""

Parameters = dict[str, float | int]


def write(model: Model, known: Known, simulated: bool = False) -> Written:
    """The parameters of a model, for the vehicle or for SIH. Raises `InputError` where its vehicle has no rotors; for
    SIH also where it has no inertia, or its rotors are not PX4's quad-x."""
    airframe = airframe_of(model)
    if simulated:  # what SIH's own rotors and frame do not do, its allocation and its filter must not know of
        airframe = airframe.with_(
            frame_drag=(0.0, 0.0, 0.0), lean=(0.0, 0.0), centre_of_mass=(0.0, 0.0), strength=()
        )
    rotors, notes = rotors_of(airframe, known)
    notes = tuple(note for note in notes if "in a hover" not in note and (simulated or "torque" not in note))
    if simulated:
        holdings = _sih_holdings(straight=not any(airframe.curve[1:]))
        parameters = {**_vehicle(airframe, rotors, known, 0.0), **_sih(airframe, rotors)}
        notes = (*notes, "SIH_KDW, the damping of the rotation, is not in the model; it stays as it is")
    else:
        factor, off = thrust_model_factor(airframe)
        holdings = _holdings(factor, off)
        parameters = _vehicle(airframe, rotors, known, factor)
        notes = (*notes, "THR_MDL_FAC and MPC_THR_HOVER: for flights that were flown with THR_MDL_FAC 0")
    notes = (*notes, *_drag_notes(airframe))
    lines = lines_of(model, holdings, "SIH" if simulated else "PX4")
    return Written(_params(parameters, header(model, lines, notes)), lines, notes)


def thrust_model_factor(airframe: Airframe) -> tuple[float, float]:
    """PX4's THR_MDL_FAC for the thrust of a motor signal, and by how much of full thrust the two differ at most from a
    tenth of the signal on. A curve that falls before full command is none of PX4's: a straight line through the hover
    stands for it."""
    top = airframe.top()
    signal = np.linspace(0.1, top, 91)
    thrust = np.array([airframe.thrust(x) for x in signal]) / airframe.thrust(top)
    if top < 1.0:
        straight = signal / hover_command(airframe) * airframe.vehicle.weight / airframe.thrust(top)
        return 0.0, float(np.max(np.abs(thrust - straight)))
    bend = signal**2 - signal
    factor = float(np.clip(np.sum((thrust - signal) * bend) / np.sum(bend**2), 0.0, 1.0))
    return factor, float(np.max(np.abs(thrust - signal - factor * bend)))


def _holdings(factor: float, off: float) -> dict[str, Holding]:
    bent = f"MPC_THR_HOVER, and THR_MDL_FAC = {factor:.3g}" + (
        "" if off < _STRAIGHT else f", from which the curve differs by up to {100 * off:.0f} % of full thrust"
    )
    return {
        "curve": Holding(bent, WHOLE if off < _STRAIGHT else ROUGHLY),
        "hub_drag": Holding("EKF2_MCOEF, the mean of both axes, which helps EKF2 to see the wind", ROUGHLY),
        "frame_drag": Holding("EKF2_BCOEF_X and _Y, which help EKF2 to see the wind; none along z", ROUGHLY),
        "centre_of_mass": Holding("CA_ROTOR*_PX and _PY, from the centre of mass as found"),
        "strength": Holding("CA_ROTOR*_CT"),
        "lean": Holding("CA_ROTOR*_AX, _AY and _AZ"),
    }


def _sih_holdings(straight: bool) -> dict[str, Holding]:
    return {
        "curve": Holding(
            "SIH_T_MAX and MPC_THR_HOVER"
            + (
                ""
                if straight
                else ", straight through the hover, with THR_MDL_FAC 0: SIH's rotors do not bend"
            ),
            WHOLE if straight else ROUGHLY,
        ),
        "lag": Holding("SIH_T_TAU: on thrust, not on speed, the same for small changes", ROUGHLY),
        "hub_drag": Holding(
            "SIH_KDV and EKF2_MCOEF, the mean of both axes, whatever the thrust; along z too", ROUGHLY
        ),
    }


def _vehicle(airframe: Airframe, rotors: Rotors, known: Known, factor: float) -> Parameters:
    vehicle = airframe.vehicle
    hover = hover_command(airframe)  # PX4 knows it as what it was before THR_MDL_FAC bent it
    out: Parameters = {
        "MPC_THR_HOVER": factor * hover**2 + (1.0 - factor) * hover,
        "THR_MDL_FAC": factor,
    }
    momentum = 0.5 * sum(airframe.hub_drag)
    bluff = [_ballistic(drag) for drag in airframe.frame_drag[:2]]
    out |= {
        "EKF2_MCOEF": min(momentum, 1.0),
        "EKF2_BCOEF_X": bluff[0],
        "EKF2_BCOEF_Y": bluff[1],
        "EKF2_DRAG_CTRL": int(momentum > 0.0 or any(bluff)),
    }
    out |= {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": len(rotors.positions)}
    length = _PX4_LENGTH if known.torque_length is None else known.torque_length
    x, y = airframe.lean
    up = (1.0 - x * x - y * y) ** 0.5
    for i, (position, direction) in enumerate(zip(rotors.positions, vehicle.rotor_directions, strict=True)):
        strength = airframe.strength[i] if i < len(airframe.strength) else 1.0
        values = {
            "PX": position[0],
            "PY": -position[1],
            "PZ": -position[2],
            "KM": direction * length,
            "CT": strength * _THRUST_COEFFICIENT,
            "AX": x,
            "AY": -y,
            "AZ": -up,
        }
        out |= {f"CA_ROTOR{i}_{key}": value + 0.0 for key, value in values.items()}  # no minus before a zero
    return out


def _ballistic(drag: float) -> float:
    """EKF2_BCOEF_* in kg/m² of a drag in 1/m; 0, which turns it off, where there is none that PX4 could hold."""
    return AIR_DENSITY / (2.0 * drag) if drag > AIR_DENSITY / (2.0 * _LARGEST_BALLISTIC) else 0.0


def _drag_notes(airframe: Airframe) -> tuple[str, ...]:
    notes = [
        f"EKF2_BCOEF_{axis}: a drag of {drag:.2g} 1/m is below what PX4 holds; 0 turns it off"
        for axis, drag in zip("XY", airframe.frame_drag[:2], strict=True)
        if drag > 0.0 and not _ballistic(drag)
    ]
    if 0.5 * sum(airframe.hub_drag) > 1.0:
        notes.append("EKF2_MCOEF: above 1, the most that PX4 holds")
    return tuple(notes)


def _sih(airframe: Airframe, rotors: Rotors) -> Parameters:
    vehicle = airframe.vehicle
    ixx, iyy, izz = moments(vehicle)
    arranged = tuple(
        (int(np.sign(x)), int(np.sign(y)), direction)
        for (x, y, _), direction in zip(vehicle.rotor_positions, vehicle.rotor_directions, strict=True)
    )
    if arranged != _QUAD_X:
        raise InputError(
            f"{told(vehicle)}: SIH flies PX4's quad-x alone (front right, rear left, front left, rear right; the first "
            "two counter-clockwise); put the rotors into that order, or export to px4"
        )
    full = vehicle.weight / 4.0 / hover_command(airframe)
    return {
        "SIH_VEHICLE_TYPE": 0,
        "SIH_MASS": vehicle.mass,
        "SIH_IXX": ixx,
        "SIH_IYY": iyy,
        "SIH_IZZ": izz,
        "SIH_IXY": 0.0,
        "SIH_IXZ": 0.0,
        "SIH_IYZ": 0.0,
        "SIH_T_MAX": full,
        "SIH_Q_MAX": full * rotors.torque_length,
        "SIH_L_ROLL": sum(abs(y) for _, y, _ in vehicle.rotor_positions) / 4.0,
        "SIH_L_PITCH": sum(abs(x) for x, _, _ in vehicle.rotor_positions) / 4.0,
        "SIH_KDV": vehicle.mass * 0.5 * sum(airframe.hub_drag),
        "SIH_T_TAU": max(airframe.lag, NO_LAG),
    }


def _params(parameters: Parameters, said: tuple[str, ...]) -> str:
    remarks = "".join(f"# {one_line(text)}\n" for text in said)
    rows = "".join(
        f"1\t1\t{name}\t{value if isinstance(value, int) else f'{value:.9g}'}\t{6 if isinstance(value, int) else 9}\n"
        for name, value in sorted(parameters.items())
    )
    return f"# Onboard parameters for Vehicle 1\n#\n{remarks}#\n# Vehicle-Id Component-Id Name Value Type\n{rows}"


TARGET = Target("px4", "PX4", ".params", write)
SIH_TARGET = Target("px4-sih", "PX4's simulator SIH", ".params", partial(write, simulated=True))
