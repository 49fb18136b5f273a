"""For the whole of the tests: how many threads, who runs what beside what, profiles of hypothesis."""

from __future__ import annotations

import os

# Before numpy is loaded, here and in every process that a test starts: with a worker a core, threads only disturb.
os.environ.update({f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")})

import pytest
from hypothesis import Phase, settings

# A mutant is dead at the first example that fails: nothing is made smaller, nothing kept, every run the same.
settings.register_profile(
    "mutation", phases=[Phase.explicit, Phase.generate], database=None, derandomize=True
)

FLIGHT = "flight"
"""Tests in real time: one worker runs them one after the other, so that none starves another."""
COMPUTING = 5
"""Steps of niceness of the other workers: as many as run on each core leave a flight the greater part of it."""
_begun: list[str] = []


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Groups for `--dist loadgroup`: one of real time, which is begun first, and one a file, for its fixtures."""
    for item in items:
        realtime = item.get_closest_marker("realtime") is not None
        group = FLIGHT if realtime else str(item.path)
        item.add_marker(pytest.mark.xdist_group(group))
    # What takes longest first: flights wait for their clock, and the ground station's analyses compute.
    items.sort(
        key=lambda item: (
            item.get_closest_marker("realtime") is None,
            item.path.parent.name != "groundstation",
        )
    )


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """A worker that begins with anything else than flights gives way to the one that flies."""
    if "PYTEST_XDIST_WORKER" in os.environ and not _begun:
        _begun.append(item.nodeid)
        if item.get_closest_marker("realtime") is None:
            os.nice(COMPUTING)
