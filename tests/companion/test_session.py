"""What the companion would open, from every place that may say so: keys, flags, files; contradictions are errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from rig import VEHICLE, free_port
from test_companion_cli import refused

from trueflight.companion.access import access_findings
from trueflight.companion.findings import DANGER, FAIL, NOTE, OK
from trueflight.companion.settings import Settings, load_settings
from trueflight.companion.zenoh_session import LOCAL, WITH_KEYS, ZenohSettings, open_session, plan_session
from trueflight.groundstation.operate.keys import make_keys
from trueflight.groundstation.operate.link import Link
from trueflight.groundstation.operate.settings import Settings as GroundSettings
from trueflight.models.access import Keys, read_keys
from trueflight.models.errors import InputError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("authority") / "keys"
    make_keys(root, ["quad5"], [("anna", "operator")])
    return root


@pytest.fixture
def keys(folder: Path) -> Keys:
    return read_keys(folder / "vehicle-quad5")


def write(path: Path, **table: object) -> str:
    path.write_text(json.dumps(table))
    return str(path)


def own_tls(keys: Keys) -> dict[str, object]:
    tls = {
        "enable_mtls": True,
        "root_ca_certificate": str(keys.path("ca.pem")),
        "listen_certificate": str(keys.path("cert.pem")),
        "listen_private_key": str(keys.path("key.pem")),
    }
    return {"link": {"tls": tls}}


def test_alone_it_listens_on_this_machine_and_with_keys_everywhere(keys: Keys) -> None:
    assert plan_session(ZenohSettings()).listen == (LOCAL,)
    assert plan_session(ZenohSettings(), keys, "quad5").listen == (WITH_KEYS,)


OPEN = {
    "listen": ZenohSettings(listen=("tcp/0.0.0.0:7447",)),
    "one of several": ZenohSettings(listen=("tcp/127.0.0.1:7447", "tcp/192.168.1.2:7447")),
    "all of IPv6": ZenohSettings(listen=("tcp/[::]:7447",)),
    "udp": ZenohSettings(listen=("udp/0.0.0.0:7447",)),
    "TLS without asking for a certificate": ZenohSettings(listen=("tls/0.0.0.0:7447",)),
    "a name": ZenohSettings(listen=("tcp/raspberrypi.local:7447",)),
    "an interface": ZenohSettings(listen=("tcp/127.0.0.1:7447#iface=eth0",)),
    "serial": ZenohSettings(listen=("serial//dev/ttyUSB0#baudrate=57600",)),
    "connect": ZenohSettings(connect=("tcp/192.168.1.2:7447",)),
    "client": ZenohSettings(mode="client", connect=("tcp/router.example:7447",)),
    "cfg": ZenohSettings(cfg=('listen/endpoints:["tcp/0.0.0.0:7447"]',)),
    "cfg from the root": ZenohSettings(cfg=('/listen/endpoints:["tcp/0.0.0.0:7447"]',)),
    "cfg of the section": ZenohSettings(cfg=('listen:{endpoints:["tcp/0.0.0.0:7447"]}',)),
    "cfg by mode": ZenohSettings(cfg=('listen/endpoints:{router:[],peer:["tcp/[::]:0"]}',)),
    "cfg connect": ZenohSettings(cfg=('connect/endpoints:["tcp/192.168.1.2:7447"]',)),
    "multicast": ZenohSettings(cfg=("scouting/multicast/enabled:true",)),
}


@pytest.mark.parametrize("how", OPEN)
def test_what_another_machine_could_reach_needs_keys_or_the_flag(how: str) -> None:
    with pytest.raises(InputError, match=r"without keys the companion .*--keys FOLDER.*--insecure"):
        plan_session(OPEN[how])
    assert plan_session(replace(OPEN[how], insecure=True)).exposed


@pytest.mark.parametrize(
    "table",
    [
        {"listen": {"endpoints": ["tcp/0.0.0.0:7447"]}},
        {"listen": {"endpoints": {"router": ["tcp/127.0.0.1:7447"], "peer": ["tcp/[::]:7000"]}}},
        {"connect": {"endpoints": ["tcp/10.0.0.1:7447"]}},
        {"scouting": {"multicast": {"enabled": True}}},
    ],
)
def test_the_same_from_a_file(table: dict[str, object], tmp_path: Path) -> None:
    path = write(tmp_path / "zenoh.json5", **table)
    with pytest.raises(InputError, match="without keys the companion"):
        plan_session(ZenohSettings(config=path))


@pytest.mark.parametrize("table", [{"mode": "router"}, {"mode": "peer"}])
def test_a_file_that_says_nothing_of_endpoints_opens_this_machine_alone(
    table: dict[str, object], tmp_path: Path
) -> None:
    plan = plan_session(ZenohSettings(config=write(tmp_path / "zenoh.json5", **table)))
    assert plan.listen == (LOCAL,)
    assert json.loads(plan.config.get_json("scouting/multicast/enabled")) is False


def test_a_file_with_mutual_tls_is_obeyed_and_its_lack_of_access_control_told(
    keys: Keys, tmp_path: Path
) -> None:
    end = "tls/0.0.0.0:7555"
    path = write(tmp_path / "zenoh.json5", listen={"endpoints": [end]}, transport=own_tls(keys))
    plan = plan_session(ZenohSettings(config=path))
    assert (plan.listen, plan.exposed) == ((end,), ())
    assert "access control" in plan.loose


def test_listen_beside_a_file_with_endpoints_is_an_error_and_never_opens_anything_else(
    keys: Keys, tmp_path: Path
) -> None:
    """A companion told to use mutual TLS opened plain TCP, because companion.toml had a `listen`."""
    path = write(
        tmp_path / "zenoh.json5", listen={"endpoints": ["tls/0.0.0.0:7555"]}, transport=own_tls(keys)
    )
    config = tmp_path / "companion.toml"
    config.write_text('[zenoh]\nlisten = ["tcp/127.0.0.1:7447"]\n')
    line = refused("run", "--config", config, "--vehicle", VEHICLE, "-c", path, "--timeout", "0.5")
    for word in ("contradicts", "zenoh.json5", "tls/0.0.0.0:7555", "listen"):
        assert word in line


CONTRADICTIONS = {
    "-e": (ZenohSettings(connect=("tcp/127.0.0.1:1",)), {"connect": {"endpoints": ["tcp/127.0.0.1:2"]}}),
    "-l": (ZenohSettings(listen=("tcp/127.0.0.1:1",)), {"listen": {"endpoints": ["tcp/127.0.0.1:2"]}}),
    "-m": (ZenohSettings(mode="peer"), {"mode": "router"}),
    "--cfg": (ZenohSettings(cfg=("timestamping/enabled:true",)), {"timestamping": {"enabled": False}}),
}


@pytest.mark.parametrize("flag", CONTRADICTIONS)
def test_a_flag_that_says_something_else_than_the_file_is_told(flag: str, tmp_path: Path) -> None:
    settings, table = CONTRADICTIONS[flag]
    path = write(tmp_path / "zenoh.json5", **table)
    with pytest.raises(InputError, match=rf"{flag}.* contradicts .*zenoh\.json5"):
        plan_session(replace(settings, config=path))


def test_flags_that_say_the_same_as_the_file_or_what_it_leaves_open_are_obeyed(tmp_path: Path) -> None:
    path = write(tmp_path / "zenoh.json5", mode="peer", listen={"endpoints": ["tcp/127.0.0.1:2"]})
    plan = plan_session(ZenohSettings(config=path, listen=("tcp/127.0.0.1:2",), connect=("tcp/127.0.0.1:3",)))
    assert (plan.listen, plan.connect) == (("tcp/127.0.0.1:2",), ("tcp/127.0.0.1:3",))


def test_two_flags_that_contradict_each_other_are_told() -> None:
    both = ZenohSettings(listen=("tcp/127.0.0.1:1",), cfg=('listen/endpoints:["tcp/127.0.0.1:2"]',))
    with pytest.raises(InputError, match=r"--cfg .* contradicts -l"):
        plan_session(both)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (ZenohSettings(connect=("nonsense",)), r"-e .*'nonsense' is no endpoint; write PROTOCOL/HOST:PORT"),
        (ZenohSettings(listen=("tpc/127.0.0.1:7447",)), r"-l .*'tpc/127\.0\.0\.1:7447' is no endpoint"),
        (ZenohSettings(mode="sideways"), r"-m .*mode = \"sideways\" \(unknown variant"),
        (ZenohSettings(cfg=("no/such:1",)), r"--cfg .*no/such = 1 \(unknown key\)"),
    ],
)
def test_what_zenoh_would_not_take_is_told_without_the_names_of_its_types(
    settings: ZenohSettings, told: str
) -> None:
    with pytest.raises(InputError, match=told) as caught:
        plan_session(settings)
    assert not {"Json5Err", "Message", "Str("} & set(str(caught.value).split())
    assert "{" not in str(caught.value)


AGAINST_KEYS = {
    "plain TCP": (ZenohSettings(listen=("tcp/127.0.0.1:7447",)), "not encrypted"),
    "the flag": (ZenohSettings(insecure=True), "--insecure contradicts"),
    "connect": (ZenohSettings(connect=("tls/10.0.0.1:7447",)), "connecting to"),
    "client": (ZenohSettings(mode="client"), "mode client"),
    "no access control": (ZenohSettings(cfg=("access_control/enabled:false",)), "contradicts"),
    "no certificates": (ZenohSettings(cfg=("transport/link/tls/enable_mtls:false",)), "contradicts"),
    "other protocols": (ZenohSettings(cfg=('transport/link/protocols:["tcp","tls"]',)), "contradicts"),
    "multicast": (ZenohSettings(cfg=("scouting/multicast/enabled:true",)), "contradicts"),
}


@pytest.mark.parametrize("what", AGAINST_KEYS)
def test_what_would_undo_the_keys_is_an_error(what: str, keys: Keys) -> None:
    settings, words = AGAINST_KEYS[what]
    with pytest.raises(InputError, match=words):
        plan_session(settings, keys, "quad5")


def test_keys_of_somebody_else_are_refused(folder: Path, keys: Keys) -> None:
    with pytest.raises(InputError, match="the vehicle file says 'x500'"):
        plan_session(ZenohSettings(), keys, "x500")
    with pytest.raises(InputError, match="keys of anna, operator"):
        plan_session(ZenohSettings(), read_keys(folder / "anna"), "quad5")


def test_a_port_in_use_names_the_endpoint_that_was_tried(tmp_path: Path) -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        end = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        path = write(tmp_path / "zenoh.json5", listen={"endpoints": [end]})
        with pytest.raises(InputError, match=f"cannot open the Zenoh session on {end}"):
            open_session(ZenohSettings(config=path))


# The ground's end


def test_the_ground_obeys_an_endpoint_beside_a_file_or_refuses_it(tmp_path: Path) -> None:
    end = f"tcp/127.0.0.1:{free_port(1)}"
    silent = write(tmp_path / "silent.json5", mode="peer")
    with pytest.raises(InputError, match=f"nobody answers on {end}"):
        Link(GroundSettings(connect=(end,), zenoh_config=silent, timeout=0.5))
    other = write(tmp_path / "other.json5", connect={"endpoints": ["tcp/127.0.0.1:1"]})
    with pytest.raises(InputError, match=r"-e .* contradicts .*other\.json5"):
        Link(GroundSettings(connect=(end,), zenoh_config=other, timeout=0.5))
    with pytest.raises(InputError, match=r"nobody answers on tcp/127\.0\.0\.1:1 "):
        Link(GroundSettings(zenoh_config=other, timeout=0.5))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"connect": ("tcp/127.0.0.1:7447",)}, "not encrypted"),
        ({"listen": ("tls/0.0.0.0:7448",)}, "listening on"),
        ({"cfg": ("access_control/enabled:false",)}, "contradicts"),
    ],
)
def test_the_ground_refuses_what_would_undo_its_keys(
    changes: dict[str, tuple[str, ...]], words: str, folder: Path
) -> None:
    with pytest.raises(InputError, match=words):
        Link(GroundSettings(keys=str(folder / "anna"), timeout=0.5, **changes))


def test_the_ground_refuses_the_keys_of_a_vehicle(folder: Path) -> None:
    with pytest.raises(InputError, match="pass a person's folder"):
        Link(GroundSettings(keys=str(folder / "vehicle-quad5"), timeout=0.5))


# Told


def test_doctor_and_preflight_say_who_may_fly_it(folder: Path, tmp_path: Path) -> None:
    def worst(settings: Settings) -> tuple[str, str]:
        finding = next(iter(access_findings(settings)))
        return finding.state, finding.value + finding.why

    vehicle = str(VEHICLE)
    assert worst(Settings(vehicle=vehicle))[0] == NOTE
    exposed = ZenohSettings(listen=("tcp/0.0.0.0:7447",))
    assert worst(Settings(vehicle=vehicle, zenoh=exposed))[0] == FAIL
    state, text = worst(
        Settings(vehicle=vehicle, zenoh=ZenohSettings(listen=("tcp/0.0.0.0:7447",), insecure=True))
    )
    assert state == DANGER and "INSECURE" in text and "tcp/0.0.0.0:7447" in text
    config = tmp_path / "companion.toml"
    config.write_text(f'keys = "{folder / "vehicle-quad5"}"\n')
    with_keys = load_settings(config)
    findings = {finding.name: finding for finding in access_findings(with_keys)}
    assert findings["access"].state == findings["keys"].state == OK
    assert "anna (operator)" in findings["access"].value


def test_an_open_address_without_keys_is_refused_by_the_command() -> None:
    line = refused("run", "--vehicle", VEHICLE, "-l", "tcp/0.0.0.0:7447", "--timeout", "0.5")
    assert all(word in line for word in ("tcp/0.0.0.0:7447", "--keys FOLDER", "--insecure"))
