"""One run of the stand-in on MAVLink: vehicle, autopilot, server and simulated pilot, by the settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.autopilot import Autopilot
from trueflight.sim_bridge.mavlink.server import PILOT_MODES, Link, Server, pilot_order
from trueflight.sim_bridge.parameters import Parameters
from trueflight.sim_bridge.settings import Settings
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.truth.hidden import Hidden


class Session:
    """A vehicle that can be connected to from its construction to `close`; use it as a context.

    `assignments` are parameters of the autopilot as `NAME=VALUE`, beside those of the settings. Raises `InputError` for
    settings that cannot be, and for ports in use.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        hidden: tuple[Hidden, ...],
        settings: Settings,
        assignments: Sequence[str] = (),
    ) -> None:
        if settings.pilot_mode not in PILOT_MODES:
            raise InputError(f"--pilot-mode {settings.pilot_mode}: choose one of {', '.join(PILOT_MODES)}")
        parameters = Parameters(vehicle)
        for name, value in settings.parameters.items():
            parameters.set_text(f"{name}={value}")
        for assignment in assignments:
            parameters.set_text(assignment)
        link = Link(("127.0.0.1", settings.port), settings.remote, settings.pilot_port)
        simulator = Simulator(vehicle, hidden, settings.seed, settings.sensor_noise, settings.battery)
        self.autopilot = Autopilot(simulator, parameters)
        self._server = Server(self.autopilot, link, settings.speed)
        self._end_us = settings.duration * 1e6 or math.inf
        self._takeover_us = settings.pilot_takes_over_at * 1e6 or math.inf
        self._pilot_mode = settings.pilot_mode

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *caught: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the ports."""
        self._server.close()

    def run(self, interrupted: Callable[[], bool]) -> None:
        """Simulate and serve until interrupted, or until the duration of the settings is over."""
        autopilot = self.autopilot
        self._server.run(
            lambda: not interrupted() and autopilot.time_us < self._end_us,
            self._let_the_pilot_take_over,
        )

    def _let_the_pilot_take_over(self, time_us: int) -> None:
        autopilot = self.autopilot
        if autopilot.armed and time_us - autopilot.armed_us >= self._takeover_us:
            self._takeover_us = math.inf
            pilot_order(autopilot, self._pilot_mode)
