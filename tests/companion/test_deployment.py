"""Models deployed in flight: real vehicle, companion and ground, good networks and deliberately bad ones."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from json_schemas import valid
from onnx_models import (
    bang_bang_model,
    constant_model,
    deep_model,
    drag_model,
    endless_model,
    greedy_model,
    linear_model,
    make_live,
    nan_model,
)
from rig import PATIENT, Bridge, Companion, free_port, wait_for

from trueflight.companion import inspection
from trueflight.companion.law.watch import GuardLimits
from trueflight.companion.store import ModelStore
from trueflight.models import contract
from trueflight.models.record import FlightRecord, read_record
from trueflight.models.vehicle import load_vehicle

pytestmark = pytest.mark.realtime

SPEED = "2"
VEHICLE = load_vehicle(Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml")
SLEW = np.array(GuardLimits().slew)
OTHER = {"name": "quad7", "mass": 0.9, "hover_thrust": 0.38}


@pytest.fixture(scope="module")
def companion(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Companion]:
    port = free_port()
    bridge = Bridge(port, "--speed", SPEED)
    folder = tmp_path_factory.mktemp("companion")
    config = folder / "companion.toml"
    config.write_text(PATIENT + "[guard]\ndeadline = 0.02\n[shadow]\nseconds = 1.0\n")
    companion = Companion(folder, port, "--config", str(config))
    yield companion
    companion.end()
    bridge.end()


@pytest.fixture(autouse=True)
def landed(companion: Companion) -> Iterator[None]:
    """What a failed test leaves in the air does not keep the next one on the ground."""
    yield
    if companion.child.poll() is None and not companion.ask("status")["ready"]:
        companion.ask("mission", {"command": "land"})


def deploy(companion: Companion, onnx: bytes, shadow: float | None = None) -> dict:
    key = contract.key("quad5", "model") + ("" if shadow is None else f"?shadow={shadow:g}")
    (reply,) = companion.session.get(key, payload=onnx, timeout=60.0)
    return json.loads(reply.ok.payload.to_string())


def told_of(companion: Companion, kind: str, onnx: bytes) -> str:
    """The text of the event of this kind about this model, once it is there."""
    name = contract.model_hash(onnx)
    found = wait_for(lambda: [text for text in companion.told(kind) if name in text], f"{kind} of {name}")
    return str(found[-1])


def record_of(companion: Companion, status: dict[str, str]) -> FlightRecord:
    record = read_record(companion.records / status["record"])
    assert not record.truncated
    return record


def jumps(record: FlightRecord) -> np.ndarray:
    """Greatest change of the applied correction between two ticks, in shares of what its slew allows."""
    correction = np.nan_to_num(record.ticks["correction"] - np.nan_to_num(record.ticks["trim"]))
    interval = np.minimum(0.1, record.ticks["interval"][1:])
    return np.abs(np.diff(correction, axis=0)) / (SLEW * interval[:, None] + 1e-9)


def changes(column: np.ndarray) -> list[str]:
    """The values of a column of words, without repetitions."""
    return [str(b) for a, b in zip(["nothing", *column[:-1]], column, strict=True) if a != b]


def test_a_good_model_is_shadowed_takes_over_without_a_step_and_is_live_after_landing(
    companion: Companion,
) -> None:
    first, second = drag_model(0.05), drag_model(0.1)
    a, b = contract.model_hash(first), contract.model_hash(second)
    assert deploy(companion, first)["state"] == "staged"
    mission = companion.fly(
        trajectory="lemniscate", parameters={"laps": 1.0, "speed": 2.0}, controller="corrected"
    )
    companion.phase("mission")
    answer = deploy(companion, second, 3.0)
    assert (answer["accepted"], answer["state"], answer["live"]) == (True, "shadow", a), answer
    # Asked at once, not after its own check: while one is in the shadow no other is even looked at.
    assert companion.ask("status")["shadow"]["hash"] == b
    again = deploy(companion, b"anything")
    assert "in the shadow for another" in again["reason"]
    assert a in told_of(companion, "model_live", second)
    status = companion.done(mission)
    assert status["state"] == "finished", status
    ticks = record_of(companion, status).ticks
    assert changes(ticks["model"]) == ["", a, b]
    assert changes(ticks["shadow"]) == ["", a, "", b, ""]
    # Deployed on the ground it proved itself before the mission, which it was in from its first tick on.
    flown = ticks["phase"] == "mission"
    assert ticks["model"][flown][0] == a
    assert ticks["guard"][flown][0] == "active"
    assert set(ticks["phase"][ticks["shadow"] == a]) == {"takeoff"}
    in_shadow = ticks["shadow"] == b
    assert ticks["t"][in_shadow][-1] - ticks["t"][in_shadow][0] == pytest.approx(3.0, abs=0.1)
    # In the shadow it is evaluated, and the live one alone is what acts.
    assert np.abs(ticks["shadow_raw"][in_shadow]).max() > 0.05
    acted = in_shadow & (ticks["guard"] == "active, shadow")
    np.testing.assert_allclose(
        ticks["shadow_raw"][acted][:, :2], 2.0 * ticks["correction_raw"][acted][:, :2], atol=0.03
    )
    assert "fading_over" in ticks["guard"]
    assert jumps(record_of(companion, status)).max() <= 1.0
    assert companion.ask("status")["live"] == b
    assert companion.ask("status")["last_good"] == a


def test_a_bad_model_deployed_on_the_ground_never_acts(companion: Companion) -> None:
    """It knows its golden vectors and stays within its authority: nothing but the flight shows what it is."""
    onnx = bang_bang_model(2.9)
    assert deploy(companion, onnx)["state"] == "staged"
    mission = companion.fly(trajectory="hover", parameters={"duration": 3.0}, controller="corrected")
    assert "worse than none" in told_of(companion, "model_refused", onnx)
    status = companion.done(mission)
    assert status["state"] == "finished", status
    ticks = record_of(companion, status).ticks
    assert contract.model_hash(onnx) in ticks["shadow"]
    assert contract.model_hash(onnx) not in ticks["model"]
    assert "mission" not in ticks["phase"][ticks["shadow"] == contract.model_hash(onnx)]
    assert np.nanmax(np.linalg.norm(ticks["position"] - ticks["position_reference"], axis=1)) < 0.5
    assert not companion.ask("status")["staged"]


BAD: dict[str, tuple[bytes, str]] = {
    "garbage": (b"\x08\x0a" + bytes(range(256)) * 8, "not an ONNX model"),
    "wrong shape": (
        linear_model(
            np.zeros((12, 3)),
            metadata={
                contract.KEY_FEATURES: [
                    {"name": name, "unit": unit, "low": -1.0, "high": 1.0}
                    for name, unit in contract.FEATURES.items()
                ]
            },
        ),
        "expected tensor(float) [N, 10]",
    ),
    "other vehicle": (
        constant_model(0, 0, 0, metadata={contract.KEY_VEHICLE: OTHER}),
        "made for vehicle 'quad7'",
    ),
    "slow": (deep_model(width=800, depth=400), "one inference takes"),
    "greedy": (greedy_model(), "cannot be evaluated"),
    "golden vectors do not fit": (drag_model(0.1, golden_error=0.01), "a golden vector differs"),
    "constant of 50 m/s^2": (constant_model(50.0, 0.0, 0.0), "times its authority"),
    "constant of 2 m/s^2": (constant_model(0.0, 0.0, 2.0), "worse than none: along z"),
    "not a number when fast": (nan_model(0.1, 0.5), "not finite|outside its training range"),
    "wrong sign": (drag_model(-0.8), "worse than none"),
}


def test_bad_models_are_refused_in_flight_and_the_vehicle_does_not_notice(companion: Companion) -> None:
    good = drag_model(0.05)
    assert deploy(companion, good)["state"] in ("staged", "live")  # an earlier test may have proved it
    mission = companion.fly(
        trajectory="lemniscate", parameters={"laps": 100.0, "speed": 2.0}, controller="corrected"
    )
    companion.phase("mission")
    wait_for(lambda: companion.ticks[-1].guard == "active", "the correction")
    time.sleep(2.0)
    begin = companion.ticks[-1].vehicle_time_us * 1e-6
    for name, (onnx, reason) in BAD.items():
        # a lap goes back along x for 5.7 s, and what fails when fast forward shows nothing meanwhile
        answer = deploy(companion, onnx, 7.0 if "fast" in name else 1.0)
        if answer["accepted"]:
            text = told_of(companion, "model_refused", onnx)
        else:
            text = answer["reason"]
        assert any(words in text for words in reason.split("|")), (name, text)
        assert companion.ask("status")["live"] == contract.model_hash(good), name
    end = companion.ticks[-1].vehicle_time_us * 1e-6
    assert companion.ask("mission", {"command": "land"})["accepted"]
    status = companion.done(mission)
    record = record_of(companion, status)
    ticks = record.ticks
    flown = ticks["phase"] == "mission"
    assert set(ticks["model"][flown]) == {contract.model_hash(good)}
    assert not any("tripped" in word for word in ticks["guard"])
    assert jumps(record).max() <= 1.0
    error = np.linalg.norm(ticks["position"] - ticks["position_reference"], axis=1)
    time_of = ticks["vehicle_time"]
    before = flown & (time_of < begin)
    during = flown & (time_of >= begin) & (time_of <= end)
    assert error[during].max() < 1.2 * error[before].max() + 0.02
    assert not list(companion.records.parent.joinpath("models").glob("*.staged"))


def rows(*points: tuple[float, float, float]) -> str:
    lines = [f"{t},{x},{y},{z},0,0,0,0,0,0,0" for t, (x, y, z) in enumerate(points)]
    return "t,x,y,z,vx,vy,vz,ax,ay,az,yaw\n" + "\n".join(lines)


def test_a_model_that_turns_bad_after_it_took_over_gives_way_to_the_last_good_one(
    companion: Companion,
) -> None:
    good, bad = drag_model(0.05), nan_model(0.1, 0.6)
    deploy(companion, good)
    still = [(0.0, 0.0, 1.0)] * 10
    there, back = [(1.2, 0.0, 1.0), *[(2.4, 0.0, 1.0)] * 4], [(1.2, 0.0, 1.0), *[(0.0, 0.0, 1.0)] * 3]
    mission = companion.fly(setpoints=rows(*still, *there, *back), controller="corrected")
    companion.phase("mission")
    assert deploy(companion, bad)["state"] == "shadow"
    told_of(companion, "model_live", bad)
    assert "not finite" in told_of(companion, "guard_trip", bad)
    assert contract.model_hash(good) in told_of(companion, "model_rolled_back", bad)
    status = companion.done(mission)
    assert status["state"] == "finished", status
    record = record_of(companion, status)
    a, b = contract.model_hash(good), contract.model_hash(bad)
    assert changes(record.ticks["model"])[-3:] == [a, b, a]
    assert jumps(record).max() <= 1.0
    ticks = record.ticks
    flown = ticks["phase"] == "mission"
    error = np.linalg.norm(ticks["position"] - ticks["position_reference"], axis=1)[flown]
    t = ticks["t"][flown] - ticks["t"][flown][0]
    # The way back is the same move, flown with the good model alone.
    assert error[t < 13.5].max() < error[t > 13.5].max() + 0.1
    listing = companion.ask("model", {"command": "list"})
    assert listing["live"] == a
    assert b not in [entry["hash"] for entry in listing["models"]]


def test_rolled_back_by_command_in_flight_it_fades_to_the_previous_model(companion: Companion) -> None:
    first, second = drag_model(0.05), drag_model(0.08)
    for onnx in (first, second):
        deploy(companion, onnx)
        mission = companion.fly(
            trajectory="lemniscate", parameters={"laps": 1.0, "speed": 2.0}, controller="corrected"
        )
        companion.phase("mission")
        if onnx is first:
            companion.ask("mission", {"command": "abort"})
            companion.done(mission)
    wait_for(lambda: companion.ticks[-1].guard == "active", "the correction")
    answer = companion.ask("model", {"command": "rollback"})
    assert answer["accepted"]
    assert answer["live"] == contract.model_hash(first)
    wait_for(lambda: companion.ticks[-1].guard == "fading_over", "the change")
    wait_for(lambda: companion.ticks[-1].guard == "active", "the previous model")
    companion.ask("mission", {"command": "land"})
    status = companion.done(mission)
    record = record_of(companion, status)
    assert changes(record.ticks["model"])[-2:] == [contract.model_hash(second), contract.model_hash(first)]
    assert jumps(record).max() <= 1.0


def test_in_a_flight_of_the_plain_cascade_a_model_is_shadowed_but_never_applied(companion: Companion) -> None:
    onnx = drag_model(0.12)
    mission = companion.fly(
        trajectory="hover", parameters={"duration": 600.0}
    )  # a busy machine inspects it slowly
    companion.phase("mission")
    assert deploy(companion, onnx)["state"] == "shadow"
    assert "next corrected flight" in told_of(companion, "model_live", onnx)
    companion.ask("mission", {"command": "land"})
    status = companion.done(mission)
    ticks = record_of(companion, status).ticks
    assert contract.model_hash(onnx) in set(ticks["shadow"])
    assert np.all(np.nan_to_num(ticks["correction"]) == 0.0)
    assert set(ticks["controller"][ticks["phase"] == "mission"]) == {"lqr"}
    assert companion.ask("status")["live"] == contract.model_hash(onnx)


def test_the_ground_deploys_waits_and_takes_back_from_the_command_line(
    companion: Companion, tmp_path: Path
) -> None:
    def ground(*arguments: object) -> subprocess.CompletedProcess[str]:
        program = "from trueflight.groundstation.commands.app import main; main()"
        line = [sys.executable, "-c", program, *map(str, arguments)]
        line += ["-e", f"tcp/127.0.0.1:{companion.zenoh_port}"]
        return subprocess.run(line, capture_output=True, text=True, timeout=60.0)

    good, bad = tmp_path / "good.onnx", tmp_path / "bad.onnx"
    good.write_bytes(drag_model(0.07))
    bad.write_bytes(constant_model(0.0, -2.5, 0.0))
    deploy(companion, drag_model(0.05))
    mission = companion.fly(trajectory="hover", parameters={"duration": 600.0}, controller="corrected")
    companion.phase("mission")
    told = ground("deploy", good, "--shadow", 0.5, "--wait", "--json")
    assert told.returncode == 0, told.stderr
    answer = valid("groundstation deploy", json.loads(told.stdout))
    assert (answer["state"], answer["hash"]) == ("live", contract.model_hash(good.read_bytes()))
    told = ground("deploy", bad, "--wait")
    assert told.returncode == 2
    assert "worse than none: along y" in told.stderr
    assert contract.model_hash(good.read_bytes()) in ground("status").stdout
    told = ground("deploy", "--roll-back")
    assert told.returncode == 0, told.stderr
    assert contract.model_hash(drag_model(0.05)) in told.stdout
    wait_for(lambda: companion.ticks[-1].model == contract.model_hash(drag_model(0.05)), "the previous model")
    companion.ask("mission", {"command": "land"})
    companion.done(mission)


class TestInspection:
    """What happens to the child never happens to the companion."""

    def inspect(self, tmp_path: Path, *files: bytes) -> list[inspection.Finding]:
        return inspection.inspect(files, VEHICLE, 0.02)

    def test_an_endless_graph_is_stopped(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(inspection, "PROCESSOR_TIME", 1)
        endless, fine = self.inspect(tmp_path, endless_model(), drag_model(0.1))
        assert not endless.accepted
        assert "of the processor" in endless.reason
        assert fine.accepted, "another child takes the rest"

    def test_a_child_that_hangs_or_crashes_refuses_its_file(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(inspection, "CHILD", (sys.executable, "-c", "import os; os.abort()"))
        (finding,) = self.inspect(tmp_path, drag_model(0.1))
        assert "crashed (SIGABRT)" in finding.reason
        monkeypatch.setattr(inspection, "PATIENCE", 0.2)
        monkeypatch.setattr(inspection, "CHILD", (sys.executable, "-c", "import time; time.sleep(60)"))
        (finding,) = self.inspect(tmp_path, drag_model(0.1))
        assert "did not end within" in finding.reason
        assert not finding.accepted


class TestStore:
    def test_a_staged_model_is_not_live_and_waits_for_its_flight_across_a_restart(
        self, tmp_path: Path
    ) -> None:
        store = ModelStore(tmp_path, VEHICLE, 0.1)
        make_live(store, drag_model(0.1))
        live, staged = contract.model_hash(drag_model(0.1)), contract.model_hash(drag_model(0.2))
        assert store.stage(drag_model(0.2)).accepted
        assert (store.live_name, store.staged_name) == (live, staged)
        again = ModelStore(tmp_path, VEHICLE, 0.1)
        assert (again.live_name, again.staged_name, again.refused_at_start) == (live, staged, [])
        names = {f"{live}.onnx", f"{staged}.staged", "history.json"}
        assert {path.name for path in tmp_path.iterdir()} == names
        (tmp_path / f"{staged}.staged").write_bytes(b"something else")
        assert ModelStore(tmp_path, VEHICLE, 0.1).staged_name == ""

    def test_a_staged_model_becomes_live_once_committed_and_never_after_it_was_discarded(
        self, tmp_path: Path
    ) -> None:
        store = ModelStore(tmp_path, VEHICLE, 0.1)
        first, second, third = (drag_model(x) for x in (0.1, 0.2, 0.3))
        make_live(store, first)
        store.stage(second)
        assert store.commit(contract.model_hash(second)) == ""
        assert store.previous_name == contract.model_hash(first)
        store.stage(third)
        store.discard(contract.model_hash(third))
        assert store.commit(contract.model_hash(third)) != ""
        assert ModelStore(tmp_path, VEHICLE, 0.1).live_name == contract.model_hash(second)
        assert store.withdraw(contract.model_hash(second)) == ""
        assert ModelStore(tmp_path, VEHICLE, 0.1).live_name == contract.model_hash(first)

    def test_the_live_model_staged_once_more_stays_live_when_it_is_discarded(self, tmp_path: Path) -> None:
        store = ModelStore(tmp_path, VEHICLE, 0.1)
        make_live(store, drag_model(0.1))
        store.stage(drag_model(0.1))
        store.discard(contract.model_hash(drag_model(0.1)))
        assert store.live is not None
        assert ModelStore(tmp_path, VEHICLE, 0.1).live is not None
