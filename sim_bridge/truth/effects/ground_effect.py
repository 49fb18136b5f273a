"""Thrust that rises near the ground."""

from __future__ import annotations

from math import sqrt
from typing import Any, ClassVar

import numpy as np

from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion, by_rotor
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.sensors import Sensors


class GroundEffect(TruthEffect):
    """Each rotor feels the images of all four below the ground, at the heights that the attitude gives their
    hubs.

    Method of images: Cheeseman and Bennett, ARC R&M 3021, 1955, for the rotor's own image; Sanchez-Cuenca et
    al., "Characterization of the aerodynamic ground effect and its influence in multirotor control", 2017,
    for those of its neighbours. The effective radius is larger than the propeller's, as measured on small
    quadrotors.
    """

    name = "ground_effect"
    what = "each rotor's thrust rises near the ground, by the images of all four"
    low, high, most = 1.2, 2.0, 6.0
    drawn = True
    units: ClassVar = {"radius_factor": "1"}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Thrust of rotor i over 1 - sum_j (R²/2) h / (d_ij² + 4 h²)^(3/2), h the mean height of hubs i and
        j.
        """
        hubs = tuple(airframe.vehicle.rotor_positions)
        radius = numbers["radius_factor"] * airframe.vehicle.rotor_radius
        half_square = 0.5 * radius * radius
        # Below a quarter of the radius the images leave their range of validity; the feet are longer than
        # that.
        least, ceiling = 0.25 * radius, 20.0 * radius
        # Rotor i feels the image of j as j feels that of i: six pairs and four images of their own.
        pairs = tuple(
            (i, j, (hubs[i][0] - hubs[j][0]) ** 2 + (hubs[i][1] - hubs[j][1]) ** 2)
            for i in range(4)
            for j in range(i)
        )
        airframe.act_on_rotors(images, half_square, least, ceiling, hubs, pairs, many=many_images)


def images(half_square: float, least: float, ceiling: float, hubs: Any, pairs: Any) -> Act:
    """Thrusts over 1 - loss, by the images of all hubs (m); heights are `least` at least, none above `ceiling`."""

    def act(m: Motion) -> None:
        z, r20, r21, r22 = m.z, m.r20, m.r21, m.r22
        if z > ceiling:
            return
        heights = [0.0, 0.0, 0.0, 0.0]
        sums = [0.0, 0.0, 0.0, 0.0]
        for i, (x, y, up) in enumerate(hubs):
            h = z + r20 * x + r21 * y + r22 * up
            heights[i] = h = h if h > least else least
            sums[i] = 0.125 / (h * h)
        for i, j, apart in pairs:
            h = 0.5 * (heights[i] + heights[j])
            square = apart + 4.0 * h * h
            image = h / (square * sqrt(square))
            sums[i] += image
            sums[j] += image
        thrusts = m.thrusts
        for i in (0, 1, 2, 3):
            loss = half_square * sums[i]
            thrusts[i] /= 1.0 - (loss if loss < 0.5 else 0.5)

    return act


def many_images(half_square: Any, least: Any, ceiling: Any, hubs: Any, pairs: Any) -> Act:
    """The same for many vehicles, of all rotors at once."""
    x, y, up = by_rotor(hubs)
    apart = by_rotor([[between] for _, _, between in pairs])[0]
    one, other = [i for i, _, _ in pairs], [j for _, j, _ in pairs]

    def act(m: Motion) -> None:
        near = m.z <= ceiling
        if not np.any(near):
            return
        heights = np.maximum(m.z + m.r20 * x + m.r21 * y + m.r22 * up, least)
        sums = 0.125 / (heights * heights)
        h = 0.5 * (heights[one] + heights[other])
        square = apart + 4.0 * h * h
        image = h / (square * np.sqrt(square))
        for pair, (i, j, _) in zip(image, pairs, strict=True):
            sums[i] += pair
            sums[j] += pair
        m.thrusts /= 1.0 - near * np.minimum(half_square * sums, 0.5)

    return act


EFFECT = GroundEffect()
