"""Models fly only with an engineer's signature where one is required, when they come and at every start."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from onnx_models import drag_model, make_live
from rig import VEHICLE, Bridge, Process, free_port, wait_for

from trueflight.companion.signature import Signatures
from trueflight.companion.store import ModelStore
from trueflight.groundstation.operate.keys import make_keys
from trueflight.groundstation.operate.link import Link
from trueflight.groundstation.operate.settings import Settings
from trueflight.models.access import SIGNING_KEY, read_keys
from trueflight.models.contract import model_hash
from trueflight.models.errors import InputError
from trueflight.models.signature import read_signature, sign
from trueflight.models.vehicle import load_vehicle

pytestmark = pytest.mark.realtime


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("authority") / "keys"
    make_keys(folder, ["quad5"], [("eve", "observer"), ("anna", "operator"), ("bob", "engineer")])
    return folder


def signatures(folder: Path, root: Path, unsigned: str = "local") -> Signatures:
    return Signatures(folder, "quad5", read_keys(root / "vehicle-quad5"), unsigned, False)


def signed(root: Path, onnx: bytes) -> bytes:
    return sign(onnx, "quad5", "bob", root / "bob" / SIGNING_KEY).to_json()


@pytest.mark.parametrize(
    ("with_keys", "unsigned", "exposed", "required"),
    [
        (False, "local", False, False),
        (False, "local", True, True),
        (False, "allowed", True, False),
        (False, "refused", False, True),
        (True, "local", False, True),
        (True, "allowed", False, False),
    ],
)
def test_unsigned_models_fly_only_where_the_settings_say_so(
    with_keys: bool, unsigned: str, exposed: bool, required: bool, root: Path, tmp_path: Path
) -> None:
    keys = read_keys(root / "vehicle-quad5") if with_keys else None
    one = Signatures(tmp_path, "quad5", keys, unsigned, exposed)
    assert one.required == required
    assert bool(one.admit(b"a model", b"")) == required


def test_the_signature_says_who_when_what_and_for_which_vehicle(root: Path) -> None:
    told = read_signature(signed(root, b"a model"))
    assert (told.signer, told.vehicle) == ("bob", "quad5")
    assert told.hash.startswith(model_hash(b"a model")) and told.time_ns > 1_700_000_000_000_000_000


def test_a_bad_signature_is_refused_even_where_none_is_required(root: Path, tmp_path: Path) -> None:
    one = signatures(tmp_path, root, "allowed")
    assert "no JSON object" in one.admit(b"a model", b"garbage")
    assert "not those that 'bob' signed" in one.admit(b"another", signed(root, b"a model"))


def test_a_replay_is_told_after_a_new_start_as_well(root: Path, tmp_path: Path) -> None:
    first, second = signed(root, b"a model"), signed(root, b"a model")
    assert signatures(tmp_path, root).admit(b"a model", second) == ""
    for old in (first, second):
        assert "sign it again" in signatures(tmp_path, root).admit(b"a model", old)
    assert signatures(tmp_path, root).admit(b"a model", signed(root, b"a model")) == ""
    (tmp_path / "signed.json").write_text("[")
    assert "damaged" in signatures(tmp_path, root).admit(b"a model", signed(root, b"a model"))


def test_every_model_on_board_is_checked_again_at_every_start(root: Path, tmp_path: Path) -> None:
    vehicle = load_vehicle(VEHICLE)
    onnx = drag_model(0.1)
    one = signatures(tmp_path, root)

    def store() -> ModelStore:
        return ModelStore(tmp_path, vehicle, 0.01, signatures(tmp_path, root).stored)

    assert one.admit(onnx, signed(root, onnx)) == ""
    make_live(store(), onnx)
    assert store().live_name == model_hash(onnx)
    signature = tmp_path / f"{model_hash(onnx)}.sig"
    whole = signature.read_bytes()
    for damage in (b"", whole.replace(b"bob", b"eve"), whole[:-20]):
        signature.write_bytes(damage)
        again = store()
        assert again.live_name == "" and again.refused_at_start
    signature.unlink()
    assert "not signed" in store().refused_at_start[0]
    signature.write_bytes(whole)
    alive = store()
    (tmp_path / f"{model_hash(onnx)}.onnx").write_bytes(onnx + b"\0")
    with pytest.raises(InputError, match="not those that 'bob' signed"):
        alive.open(model_hash(onnx))


def test_signatures_of_models_that_are_gone_are_swept(root: Path, tmp_path: Path) -> None:
    one = signatures(tmp_path, root)
    assert one.admit(b"a model", signed(root, b"a model")) == ""
    assert list(tmp_path.glob("*.sig"))
    one.sweep()
    assert not list(tmp_path.glob("*.sig"))


def test_a_companion_with_keys_is_read_flown_and_given_models_by_role(root: Path, tmp_path: Path) -> None:
    """Real processes: the whole way from the keys to a live model, and the same after a new start."""
    mavlink, port = free_port(), free_port(1)
    bridge = Bridge(mavlink, "--hidden", "none")
    flags = ("--keys", str(root / "vehicle-quad5"))
    settings = Settings(connect=(f"tls/localhost:{port}",), timeout=10.0)
    onnx = drag_model(0.1)

    def link(who: str) -> Link:
        return Link(replace(settings, keys=str(root / who)))

    try:
        for start in range(2):
            companion = _run(tmp_path, mavlink, port, flags)
            try:
                with link("eve") as eve:
                    status = eve.status()
                    assert status["access"]["keys"] == "quad5.vehicle" and not eve.warning
                    assert eve.records() == []
                    with pytest.raises(InputError, match="eve's, observer: 'mission' needs operator"):
                        eve.request("mission", {"trajectory": "hover"})
                    ticks: list[object] = []
                    eve.follow(ticks.append, history=5)
                    wait_for(lambda seen=ticks: len(seen) > 20, "ticks over TLS")
                with link("anna") as anna:
                    assert anna.request("mission", {"command": "land"})["accepted"]
                    with pytest.raises(InputError, match="anna's, operator: 'model' needs engineer"):
                        anna.deploy(onnx)
                with link("bob") as bob:
                    if start:
                        assert bob.status()["staged"]["hash"] == model_hash(onnx), "checked again, and waits"
                        assert bob.status()["access"]["signers"] == {model_hash(onnx): "bob"}
                    else:
                        with pytest.raises(InputError, match="it is not signed"):
                            bob.request("model", onnx, 60.0)
                        assert bob.deploy(onnx)["state"] == "staged"
                    if start:
                        assert bob.roll_back()["accepted"]
            finally:
                companion.end()
    finally:
        bridge.end()


def _run(folder: Path, mavlink: int, port: int, flags: tuple[str, ...]) -> Process:
    """A companion process without the rig's own session, which has no keys."""
    program = "from trueflight.companion.cli import main; main()"
    companion = Process(
        ["-c", program, "run", "--vehicle", str(VEHICLE), "--connect", f"udpin://127.0.0.1:{mavlink}"]
        + ["--records", str(folder / "records"), "--models", str(folder / "models")]
        + ["-l", f"tls/127.0.0.1:{port}", *flags]
    )
    companion.ready()
    return companion
