"""A seed hides for ever what it hid: what published records and results were flown with can be flown again."""

from __future__ import annotations

from pathlib import Path

import pytest

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth import effects
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.effects import EFFECTS
from trueflight.sim_bridge.truth.hidden import choose, pool

BY_SEED_7 = {
    "thrust_gain": {"gain": 0.955850827444},
    "thrust_curve": {"speed_blend": 0.783379778033},
    "battery_sag": {"exponent": 1.3631296513},
    "motor_lag": {"time_constant": 0.0489588480306},
    "transport_delay": {"extra_delay": 0.0241529191974},
    "rotor_drag": {"x": 0.400593620218, "y": 0.421487480871},
    "parasitic_drag": {"x": 0.0567546346035, "y": 0.0638960991377, "z": 0.0829772029747},
    "ground_effect": {"radius_factor": 1.60034484883},
    "wind": {"speed": 4.00540561733, "east": 2.76943233217, "north": -2.89370328763, "drag": 0.264614525405},
    "accelerometer_bias": {
        "size": 0.211685376252,
        "x": -0.104071467973,
        "y": 0.120497643422,
        "z": 0.139499627249,
    },
    "estimator_delay": {"delay": 0.012},
    "payload": {"mass_fraction": 0.0897474786145, "time": 12},
    "translational_lift": {"lift": 0.0315298517213},
    "ceiling_effect": {"radius_factor": 2.59259960929, "height": 2.79268136309},
    "vortex_ring": {"loss": 0.195294996788},
    "thrust_misalignment": {"angle": 0.0306035560515, "x": -4.80965859946e-05, "y": -0.0306035182571},
    "imu_lever_arm": {
        "length": 0.0530394861365,
        "x": 0.0055528487614,
        "y": -0.0490214526506,
        "z": 0.019474345696,
    },
    "com_offset": {"distance": 0.0099294548977, "x": 0.00933178495097, "y": -0.00339291382063},
    "rotor_damage": {"loss": 0.120682396115, "rotor": 3},
    "rate_loop_lag": {"time_constant": 0.0728279036014},
    "gyroscopic": {"inertia": 3.23168303783e-05},
}
"""As drawn when all effects were one file; what comes later is added when its flights are published."""

RICH_BY_SEED_7 = {
    "rotor_drag": 0.466267949139,
    "parasitic_drag": 0.0143645142941,
    "ground_effect": 1.91089032726,
    "battery_sag": 1.76220866783,
    "motor_lag": 0.035985109857,
    "thrust_curve": 0.196718615976,
    "thrust_gain": 1.04675736812,
    "estimator_delay": 0.012,
}


@pytest.mark.parametrize("name", list(BY_SEED_7))
def test_a_seed_draws_what_it_always_drew(vehicle: Vehicle, name: str) -> None:
    (hidden,) = choose([name], vehicle, 7)
    assert (hidden.name, hidden.parameters) == (name, pytest.approx(BY_SEED_7[name], rel=1e-11))


def test_random_any_and_rich_draw_what_they_always_drew(vehicle: Vehicle) -> None:
    drawn = {r: [one.name for one in choose([r], vehicle, 7, 4)] for r in ("random", "any")}
    assert drawn == {
        "random": ["battery_sag", "motor_lag", "wind", "thrust_gain"],
        "any": ["rotor_damage", "parasitic_drag", "motor_lag", "thrust_curve"],
    }
    sizes = {one.name: next(iter(one.parameters.values())) for one in choose(["rich"], vehicle, 7)}
    assert list(sizes) == list(RICH_BY_SEED_7)
    assert sizes == pytest.approx(RICH_BY_SEED_7, rel=1e-11)
    assert len(pool("random")) == 10 and len(pool("any")) == 16


def test_every_file_of_the_folder_is_one_effect_by_its_name() -> None:
    files = {path.stem for path in Path(effects.__file__).parent.glob("*.py")} - {"__init__"}
    assert files == set(EFFECTS)
    for name, effect in EFFECTS.items():
        assert isinstance(effect, TruthEffect) and effect.name == name
        assert type(effect).__module__.endswith(f".effects.{name}")
