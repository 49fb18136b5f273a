"""For the whole of the tests: how many threads, who runs what beside what, profiles of hypothesis."""

from __future__ import annotations

import os
from typing import Any

# Before numpy is loaded, here and in every process that a test starts: with a worker a core, threads only disturb.
os.environ.update({f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")})
# GNU readline, which pytest loads, sets it for child processes: the tests' workers.
os.environ.pop("COLUMNS", None)

import pytest
from groups import group_of, realtime
from hypothesis import Phase, settings

# A mutant is dead at the first example that fails: nothing is made smaller, nothing kept, every run the same.
settings.register_profile(
    "mutation", phases=[Phase.explicit, Phase.generate], database=None, derandomize=True
)

COMPUTING = 10
"""Steps of niceness of the workers that do not fly: as many as run on each core leave a flight its greater part."""
_begun: list[str] = []


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Work is given out by `group_of`, in the order below. The marks of single tests are unknown where it is given."""
    from xdist.scheduler import LoadScopeScheduling

    class OneFlies(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(nodeid, config.rootpath)

    config.option.loadscopereorder = False
    return OneFlies(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes longest first: flights wait for their clock, and the ground station's analyses compute."""
    items.sort(key=lambda item: (not realtime(item.path), item.path.parent.name != "groundstation"))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """A worker that begins with anything else than flights gives way to the one that flies."""
    if "PYTEST_XDIST_WORKER" in os.environ and not _begun:
        _begun.append(item.nodeid)
        if not realtime(item.path):
            os.nice(COMPUTING)
