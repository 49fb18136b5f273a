"""The training database: what it covers, that it is repeatable, and that its folder is neither mixed nor lost."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from trueflight.companion.stopping import Safety
from trueflight.models.database import EMPTIEST, FULLEST, Collection, database, record_name
from trueflight.models.errors import InputError


@pytest.mark.parametrize("seed", range(4))
def test_a_database_lasts_as_asked_covers_every_manoeuvre_and_stays_inside_the_fence(seed: int) -> None:
    sorties = database(seed, 30.0)
    seconds = [sortie.path.duration for sortie in sorties]
    assert 1800.0 <= sum(seconds) < 1800.0 + seconds[-1]
    share = {name: 0.0 for name in {sortie.trajectory for sortie in sorties}}
    for sortie, duration in zip(sorties, seconds, strict=True):
        share[sortie.trajectory] += duration / sum(seconds)
        assert Safety().check_trajectory(sortie.path) == ""
    wanted = {"translation", "steps", "rotation", "spiral", "circle", "lemniscate", "low_pass", "excitation"}
    assert set(share) == wanted  # and never the scenario that models are judged by
    assert all(0.03 < part < 0.35 for part in share.values())
    planes = {sortie.parameters["plane"] for sortie in sorties if sortie.trajectory == "translation"}
    assert planes == {"xy", "xz", "yz"}
    charges = np.array([sortie.charge for sortie in sorties])
    assert charges.min() < EMPTIEST + 0.1 and charges.max() > FULLEST - 0.1
    low = [sortie for sortie in sorties if sortie.path.bounds[0][2] < 0.3]
    assert len(low) > 8 and min(sortie.charge for sortie in low) >= 0.5


def test_the_lemniscate_that_models_are_judged_by_is_not_in_it() -> None:
    for seed in range(20):
        flown = [sortie for sortie in database(seed, 30.0) if sortie.trajectory == "lemniscate"]
        assert flown, "there are others"
        assert min(float(sortie.parameters["height"]) for sortie in flown) > 0.2


def test_the_same_seed_is_the_same_database_and_a_longer_one_begins_with_it() -> None:
    assert database(3, 10.0) == database(3, 10.0) == database(3, 20.0)[: len(database(3, 10.0))]
    assert database(3, 10.0) != database(4, 10.0)
    with pytest.raises(InputError, match="--minutes"):
        database(3, 0.0)


def test_a_collection_is_continued_with_the_same_settings_only(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "db"
    begun = Collection(folder, {"seed": 1, "hidden": ("rich",)})
    name = record_name(1, database(1)[0])
    (folder / name).write_bytes(b"a record")
    begun.add(name, {"seconds": 2.0})
    begun.add("002-lost.mcap", {"seconds": 2.0})
    assert Collection(folder, {"seed": 1, "hidden": ("rich",)}).flown == {
        name: {"seconds": 2.0}
    }  # what is there
    with pytest.raises(InputError, match="begun with seed 1, now 2"):
        Collection(folder, {"seed": 2, "hidden": ("rich",)})
    assert json.loads((folder / "collection.json").read_text())["settings"]["seed"] == 1


def test_a_foreign_folder_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("important")
    with pytest.raises(InputError, match="not empty, and no collection"):
        Collection(tmp_path, {})
    (tmp_path / "collection.json").write_text("[1, 2]")
    with pytest.raises(InputError, match="not the index of a collection"):
        Collection(tmp_path, {})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["collection.json", "thesis.txt"]
    with pytest.raises(InputError, match="cannot collect flights there"):
        Collection(tmp_path / "thesis.txt" / "db", {})
