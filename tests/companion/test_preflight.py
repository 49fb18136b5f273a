"""`companion preflight`: what stands against a flight, told by the autopilot, and changed only when asked."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from json_schemas import valid
from rig import VEHICLE, Bridge, free_port, wait_for
from test_companion_cli import companion

from trueflight.companion.message_rates import Rates, odometry_too_low
from trueflight.companion.pose import PoseSettings
from trueflight.companion.preflight import hover_of, judge
from trueflight.companion.required_parameters import required_parameters
from trueflight.companion.settings import Settings


@pytest.fixture
def bridge(request: pytest.FixtureRequest) -> Iterator[tuple[Bridge, int]]:
    port = free_port()
    parameters = ["COM_OF_LOSS_T=1", *getattr(request, "param", [])]
    flags = [text for parameter in parameters for text in ("--param", parameter)]
    bridge = Bridge(port, *flags)
    yield bridge, port
    bridge.end()


def look(port: int, *flags: object) -> tuple[int, dict[str, Any]]:
    """Exit code and report."""
    address = f"udpin://127.0.0.1:{port}"
    result = companion("preflight", "--connect", address, "--vehicle", VEHICLE, "--json", *flags)
    assert result.stdout, result.stderr
    return result.returncode, valid("companion preflight", json.loads(result.stdout))


def rows(report: dict[str, Any], part: str) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in report[part]}


def test_parameters_are_reported_and_changed_only_when_asked(
    bridge: tuple[Bridge, int], tmp_path: Path
) -> None:
    port = bridge[1]
    code, report = look(port, "--records", tmp_path)
    assert code == 2
    assert not report["ready"]
    found = rows(report, "parameters")
    assert found["COM_OBL_RC_ACT"]["state"] == "fail"
    assert found["COM_OBL_RC_ACT"]["value"] == "0"
    assert found["COM_OBL_RC_ACT"]["change"] == 4
    assert found["COM_OF_LOSS_T"]["state"] == "ok"
    assert all(row["why"] for row in found.values())
    code, report = look(port, "--records", tmp_path, "--set-params")
    assert code == 0, report
    assert report["ready"]
    # Looking had changed nothing: it is changed from 0.
    assert any(line.startswith("COM_OBL_RC_ACT: 0 -> 4") for line in report["changed"])
    # The stand-in, like PX4, refuses an INT32 that is sent as a float and the other way round: both kinds took.
    found = rows(report, "parameters")
    assert {
        name: row["value"] for name, row in found.items() if name in ("COM_RC_OVERRIDE", "GF_MAX_HOR_DIST")
    } == {
        "COM_RC_OVERRIDE": "3",
        "GF_MAX_HOR_DIST": "15",
    }
    assert not any("not set" in line for line in report["changed"])
    assert report["autopilot"].startswith("PX4 1.15")
    assert look(port, "--records", tmp_path, "--set-params")[1]["changed"] == []


@pytest.mark.parametrize("bridge", [["MPC_THR_HOVER=0.6", "COM_OBL_RC_ACT=4"]], indirect=True)
def test_what_refuses_arming_is_told_in_words_and_hover_thrust_compared(
    bridge: tuple[Bridge, int], tmp_path: Path
) -> None:
    bridge[0].pilot("KILL")
    code, report = look(bridge[1], "--records", tmp_path)
    assert code == 2
    (failed,) = [row for row in report["arming"] if row["state"] == "fail"]
    assert failed["value"] == "the kill switch is on"
    assert "flip it back" in failed["why"]
    hover = rows(report, "hover_thrust")["MPC_THR_HOVER"]
    assert hover["state"] == "warn"
    assert (hover["value"], hover["wanted"]) == ("0.60", "0.38")


def test_too_low_a_rate_names_the_parameter(bridge: tuple[Bridge, int], tmp_path: Path) -> None:
    port = bridge[1]
    _, report = look(port, "--records", tmp_path, "--rate", 900)
    odometry = rows(report, "rates")["odometry"]
    assert odometry["state"] == "fail"
    assert "EKF2_PREDICT_US to 1000" in odometry["why"]
    slow = Rates(odometry=125.0, imu=250.0, battery=10.0, esc=0.0, longest_gap=0.01, duration=1.0)
    assert odometry_too_low(slow, 100.0) == ""
    reason = odometry_too_low(slow, 250.0)
    assert "125 Hz" in reason
    assert "EKF2_PREDICT_US to 4000" in reason
    reason = odometry_too_low(replace(slow, odometry=40.0), 100.0)
    assert "EKF2_PREDICT_US" not in reason, "the estimator is fast enough for 100 Hz"
    assert "MAV_x_RATE" in reason
    assert "MAV_x_MODE" in odometry_too_low(replace(slow, odometry=0.0), 100.0)


def test_an_armed_vehicle_is_left_alone(bridge: tuple[Bridge, int], tmp_path: Path) -> None:
    from trueflight.companion.vehicle_link import VehicleLink

    port = bridge[1]
    link = VehicleLink(f"udpin://127.0.0.1:{port}")
    try:
        bridge[0].pilot("POSCTL")
        wait_for(lambda: link.commands.arm() == "", "the estimator to be ready")
    finally:
        link.close()
    result = companion("preflight", "--connect", f"udpin://127.0.0.1:{port}", "--vehicle", VEHICLE)
    assert result.returncode == 2
    assert "the vehicle is armed" in result.stderr


class TestRequiredParameters:
    """What is wanted depends on how the vehicle is to fly."""

    def names(self, settings: Settings) -> set[str]:
        return {required.name for required in required_parameters(settings)}

    def test_a_fast_loop_wants_a_fast_estimator(self) -> None:
        assert "EKF2_PREDICT_US" not in self.names(Settings(rate=100.0))
        (required,) = [w for w in required_parameters(Settings(rate=250.0)) if w.name == "EKF2_PREDICT_US"]
        assert required.rule.good(4000)
        assert not required.rule.good(10000)
        assert required.rule.change(10000) == 4000
        assert required.reboot

    def test_mocap_wants_the_estimator_to_use_it(self) -> None:
        settings = Settings(pose=PoseSettings(enabled=True))
        assert {"EKF2_EV_CTRL", "EKF2_HGT_REF", "EKF2_GPS_CTRL"} <= self.names(settings)
        assert "EKF2_EV_CTRL" not in self.names(Settings())
        (required,) = [w for w in required_parameters(settings) if w.name == "EKF2_EV_CTRL"]
        assert required.rule.good(11)
        assert required.rule.good(15)
        assert not required.rule.good(4)
        assert required.rule.change(4) == 15, "what somebody set besides stays"

    def test_every_change_is_good(self) -> None:
        changed = set()
        for required in required_parameters(Settings(rate=250.0, pose=PoseSettings(enabled=True))):
            for value in (-1, 0, 1, 7, 20000):
                change = required.rule.change(value)
                if change is not None:
                    changed.add(required.name)
                    assert required.rule.good(change), required.name
        assert {"COM_OF_LOSS_T", "COM_OBL_RC_ACT", "EKF2_EV_CTRL"} <= changed


def ticks(seconds: float, thrust: float, speed: float = 0.0, tilt: float = 0.0) -> dict[str, np.ndarray]:
    """Columns of a record at 100 Hz at 1 m."""
    n = round(100 * seconds)
    rng = np.random.default_rng(0)
    return {
        "t": 0.01 * np.arange(n),
        "interval": np.full(n, 0.01),
        "velocity": np.tile([speed, 0.0, 0.0], (n, 1)),
        "quaternion": np.tile([math.cos(tilt / 2), math.sin(tilt / 2), 0.0, 0.0], (n, 1)),
        "position": np.tile([0.0, 0.0, 1.0], (n, 1)),
        "setpoint_sent": np.ones(n, bool),
        "armed": np.ones(n, bool),
        "thrust_command": thrust + 0.01 * rng.normal(size=n),
        "battery_voltage": np.full(n, 15.5),
    }


def test_hover_thrust_is_learned_from_hover_alone() -> None:
    found = hover_of(ticks(5.0, 0.41), "a.mcap")
    assert found is not None
    assert found.thrust == pytest.approx(0.41, abs=0.002)
    assert found.voltage == 15.5
    assert found.seconds == pytest.approx(5.0)
    assert hover_of(ticks(1.0, 0.41), "short") is None
    assert hover_of(ticks(5.0, 0.41, speed=1.0), "moving") is None
    assert hover_of(ticks(5.0, 0.41, tilt=0.2), "tilted") is None
    low = ticks(5.0, 0.41)
    low["position"][:, 2] = 0.2
    assert hover_of(low, "in ground effect") is None


def test_a_parameter_that_a_release_renamed_is_looked_for_under_its_new_name() -> None:
    required = next(
        required for required in required_parameters(Settings()) if required.name == "COM_RC_OVERRIDE"
    )
    old = judge({"COM_RC_OVERRIDE": 1}.get, required)
    new = judge({"MAN_OVERRIDE_SPD": -1.0}.get, required)
    assert (old.name, old.value, old.change) == ("COM_RC_OVERRIDE", "1", 3)
    assert (new.name, new.state, new.change) == ("MAN_OVERRIDE_SPD", "warn", 1.0)
    assert judge({"MAN_OVERRIDE_SPD": 1.0}.get, required).state == "ok"
    assert judge({}.get, required).state == "note"
    required = next(
        required for required in required_parameters(Settings()) if required.name == "EKF2_NOAID_TOUT"
    )
    assert judge({"EKF2_NOAID_TOUT": 5_000_000}.get, required).value == "5000000"
