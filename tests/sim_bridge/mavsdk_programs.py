"""Programs as MAVSDK's documentation writes them, run as `python mavsdk_programs.py NAME URL`.

`takeoff_and_land` follows the example of that name, `offboard` the ones for position, velocity, attitude and
rates. Both wait for what they have asked for instead of sleeping, and print what they saw as JSON.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable

from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.offboard import (
    Attitude,
    AttitudeRate,
    Offboard,
    OffboardError,
    PositionNedYaw,
    VelocityNedYaw,
)
from mavsdk.plugins.telemetry import Telemetry
from mavsdk.system import System


def wait(condition: Callable[[], bool], limit: float = 20.0) -> None:
    end = time.monotonic() + limit
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(condition.__code__)
        time.sleep(0.02)


def takeoff_and_land(drone: System) -> dict[str, object]:
    action, telemetry = Action(drone), Telemetry(drone)
    wait(telemetry.health_all_ok)
    altitudes = [action.get_takeoff_altitude(), action.get_return_to_launch_altitude()]
    action.arm()
    action.takeoff()
    wait(lambda: telemetry.position().relative_altitude_m > 2.0)
    home = telemetry.home()
    north = home.latitude_deg + math.degrees(3.0 / 6371000.0)
    action.goto_location(north, home.longitude_deg, home.absolute_altitude_m + 3.0, 0.0)
    wait(lambda: telemetry.position_velocity_ned().position.north_m > 2.7)
    action.land()
    wait(lambda: not telemetry.armed())
    return {"altitudes": altitudes, "end": telemetry.position().relative_altitude_m}


def offboard(drone: System) -> dict[str, object]:
    action, telemetry, flight = Action(drone), Telemetry(drone), Offboard(drone)
    wait(telemetry.health_all_ok)
    telemetry.set_rate_position_velocity_ned(50.0)
    refused = ""
    try:
        flight.start()
    except OffboardError as error:
        refused = str(error)

    def down() -> float:
        return telemetry.position_velocity_ned().position.down_m

    action.arm()
    flight.set_position_ned(PositionNedYaw(0.0, 0.0, 0.0, 0.0))
    flight.start()
    flight.set_position_ned(PositionNedYaw(0.0, 0.0, -2.0, 90.0))
    wait(lambda: down() < -1.8 and abs(telemetry.attitude_euler().yaw_deg - 90.0) < 5.0)
    flight.set_velocity_ned(VelocityNedYaw(1.0, 0.0, 0.0, 90.0))
    wait(lambda: telemetry.position_velocity_ned().position.north_m > 1.0)
    flight.set_position_ned(PositionNedYaw(1.0, 0.0, -3.0, 0.0))
    wait(lambda: down() < -2.8 and abs(telemetry.attitude_euler().yaw_deg) < 5.0)
    # Nose down by attitude flies north; then level by rates, still at the thrust that hovers.
    flight.set_attitude(Attitude(0.0, -8.0, 0.0, 0.385))
    wait(lambda: telemetry.position_velocity_ned().velocity.north_m_s > 0.5)
    flight.set_attitude_rate(AttitudeRate(0.0, 8.0, 0.0, 0.385))
    wait(lambda: telemetry.attitude_euler().pitch_deg > 5.0)
    flight.stop()
    stopped = str(telemetry.flight_mode())
    wait(lambda: math.hypot(*_velocity(telemetry)) < 0.3)
    action.land()
    wait(lambda: not telemetry.armed())
    return {"refused": refused, "stopped": stopped, "end": down()}


def _velocity(telemetry: Telemetry) -> tuple[float, float]:
    velocity = telemetry.position_velocity_ned().velocity
    return velocity.north_m_s, velocity.east_m_s


if __name__ == "__main__":
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    mavsdk.add_any_connection(sys.argv[2])
    found = mavsdk.first_autopilot(10.0)
    assert found is not None
    program = {"takeoff_and_land": takeoff_and_land, "offboard": offboard}[sys.argv[1]]
    sys.stdout.write(json.dumps(program(found)) + "\n")
