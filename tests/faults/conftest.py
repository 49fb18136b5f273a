"""Fixtures of the fault tests: the vehicle, a man in the middle, the companion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from mitm import ManInTheMiddle, nothing
from rig import Bridge, Companion


@dataclass
class Link:
    """A simulated vehicle, a companion that flies it, and what stands between them."""

    bridge: Bridge
    middle: ManInTheMiddle
    companion: Companion


@pytest.fixture(scope="module")
def link(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Link]:
    """Real processes on loopback, in real time; one for all tests of a module."""
    middle = ManInTheMiddle()
    bridge = Bridge(middle.port, "--param", "COM_OF_LOSS_T=0.5", "--param", "COM_OBL_RC_ACT=4")
    companion = Companion(tmp_path_factory.mktemp("faults"), middle.companion_port, settings="")
    yield Link(bridge, middle, companion)
    middle.fault = nothing
    companion.end()
    bridge.end()
    middle.close()
