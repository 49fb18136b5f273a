"""Controllers that have no form for arrays, those of installed packages too: each its own, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from trueflight.companion.law.control import ControlLaw, State
from trueflight.companion.law.controllers import make_controller
from trueflight.models.trajectory import ReferenceSample, Trajectory
from trueflight.sim_bridge.many.cascade import States, Steps
from trueflight.sim_bridge.many.courses import Courses, References
from trueflight.sim_bridge.plan import Plan


class OneByOne:
    """The companion's own controllers, fed from arrays and read into them."""

    def __init__(self, laws: Sequence[ControlLaw], plans: Sequence[Plan], period: float) -> None:
        self._controllers = [
            make_controller(plan.controller, law) for plan, law in zip(plans, laws, strict=True)
        ]
        self._courses = Courses(plans, period)
        self.inference = np.zeros(len(plans))

    def start(self, which: np.ndarray) -> None:
        """For some (N,) the mission begins with the next tick."""
        for i in np.flatnonzero(which).tolist():
            self._controllers[i].start()

    def guard(self) -> None:
        """There is none."""

    def step(self, states: States, reference: References, tick: int, dt: float) -> Steps:
        """One tick of all."""
        position, velocity, quaternion, rates, force = (
            list(map(tuple, array.T.tolist()))
            for array in (
                *(states.position, states.velocity, states.quaternion),
                *(states.angular_velocity, states.specific_force),
            )
        )
        heights, volts = states.height.tolist(), states.battery_voltage.tolist()
        steps = []
        for i, controller in enumerate(self._controllers):
            leg, t = self._courses.leg_at(i, tick)
            preview = partial(_ahead, leg, t)
            state = State(position[i], velocity[i], quaternion[i], heights[i], volts[i], rates[i], force[i])
            steps.append(controller.step(state, preview, dt))
        return Steps(
            np.array([step.feedback.thrust for step in steps]),
            np.array([step.feedback.body_rate for step in steps]).T,
            np.array([step.correction for step in steps]).T,
            np.array([step.correction_raw for step in steps]).T,
            np.array([step.command.body_rate for step in steps]).T,
            np.array([step.thrust_command for step in steps]),
            np.array([step.trim for step in steps]).T,
        )


def _ahead(leg: Trajectory, t: float, ahead: float) -> ReferenceSample:
    return leg.at(t + ahead)
