"""What an installation knows of itself; `install.py` beside this file tries a whole one."""

from importlib.metadata import version

import pytest

import trueflight
from trueflight.groundstation.commands.demo import SAMPLES
from trueflight.groundstation.study.demonstration import REAL


def test_the_version_is_the_installed_one() -> None:
    assert trueflight.__version__ == version("trueflight")
    with pytest.raises(AttributeError, match="no attribute 'verson'"):
        _ = trueflight.verson  # type: ignore[attr-defined]


def test_the_real_flights_of_the_demonstration_are_in_the_repository() -> None:
    assert [file for file, _ in REAL if not (SAMPLES / file).is_file()] == []
