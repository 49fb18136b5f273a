"""Every attack of the list, once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hostile_network import ATTACKS, Attack
from network_stage import Stage


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    folder: Path = tmp_path_factory.mktemp("hostile")
    with Stage(folder) as there:
        yield there


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: attack.name)
def test_the_promise_holds(attack: Attack, stage: Stage) -> None:
    assert attack.run(stage) == "", attack.expected
