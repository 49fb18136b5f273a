"""The models on board: which one is live, after what is deployed, rolled back and read again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from onnx_models import constant_model, drag_model, make_live

from trueflight.companion.store import ModelStore
from trueflight.models import contract
from trueflight.models.vehicle import load_vehicle

VEHICLE = load_vehicle(Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml")


class TestStore:
    def test_the_last_accepted_model_is_live_and_survives_a_restart(self, tmp_path: Path) -> None:
        store = ModelStore(tmp_path, VEHICLE, 0.1)
        assert store.live is None
        first, second = constant_model(0.1, 0, 0), drag_model(0.2)
        make_live(store, first)
        make_live(store, second)
        answer = store.describe()
        assert answer["live"] == contract.model_hash(second)
        assert [entry["hash"] for entry in answer["models"]] == [
            contract.model_hash(m) for m in (first, second)
        ]
        again = ModelStore(tmp_path, VEHICLE, 0.1)
        assert again.live is not None
        assert again.live.info.hash == contract.model_hash(second)
        assert again.refused_at_start == []

    def test_a_refused_model_leaves_the_live_one_alone(self, tmp_path: Path) -> None:
        store = ModelStore(tmp_path, VEHICLE, 0.1)
        make_live(store, constant_model(0.1, 0, 0))
        assert not store.stage(b"nonsense").accepted
        assert store.commit(contract.model_hash(b"nonsense")) != ""
        assert store.live is not None
        assert store.live([0.0] * 10) == pytest.approx([0.1, 0.0, 0.0])

    def test_rolling_back_goes_through_the_earlier_models_to_none(self, tmp_path: Path) -> None:
        store = ModelStore(tmp_path, VEHICLE, 0.1)
        make_live(store, constant_model(0.1, 0, 0))
        make_live(store, constant_model(0.2, 0, 0))
        assert store.roll_back()["accepted"]
        assert store.live is not None
        assert store.live([0.0] * 10) == pytest.approx([0.1, 0.0, 0.0])
        assert store.roll_back()["live"] == ""
        assert store.live is None
        assert not store.roll_back()["accepted"]

    def test_a_model_that_no_longer_fits_is_not_live_after_a_restart(self, tmp_path: Path) -> None:
        make_live(ModelStore(tmp_path, VEHICLE, 0.1), constant_model(0.1, 0, 0))
        heavier = ModelStore(tmp_path, replace(VEHICLE, mass=0.9), 0.1)
        assert heavier.live is None
        assert "made for mass" in heavier.refused_at_start[0]
        for path in tmp_path.glob("*.onnx"):
            path.write_bytes(path.read_bytes()[:-10])
        assert ModelStore(tmp_path, VEHICLE, 0.1).live is None
        (tmp_path / "history.json").write_text(json.dumps(["../absent", 5, "0123456789ab"]))
        assert "0123456789ab" in ModelStore(tmp_path, VEHICLE, 0.1).refused_at_start[0]
