"""Attacks over the network on a companion with keys, each with what must not happen; bounded, to be looped.

`ATTACKS` is the list. Each attack gets a `Stage`, a vehicle with real Zenoh sessions, real certificates and real ports
on loopback (without an autopilot behind it), and returns '' where the promise held, otherwise what happened instead:

    with Stage(folder) as stage:
        for attack in ATTACKS:
            print(attack.name, attack.run(stage) or "held")
"""

from __future__ import annotations

import json
import random
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import zenoh
from network_stage import HEARD, ORDER, PEOPLE, Open, Stage, free_port, tls, vehicle

from trueflight.companion.zenoh_session import ZenohSettings, open_session
from trueflight.groundstation.operate.keys import make_keys
from trueflight.groundstation.operate.link import Link, companions
from trueflight.groundstation.operate.settings import Settings
from trueflight.models import access
from trueflight.models.access import NEEDS, may, read_keys
from trueflight.models.contract import key, model_hash
from trueflight.models.errors import InputError
from trueflight.models.signature import Signature, sign


@dataclass(frozen=True)
class Attack:
    """`run` returns '' where `expected` held, otherwise what happened."""

    name: str
    expected: str
    run: Callable[[Stage], str]


ATTACKS: list[Attack] = []


def attack(expected: str) -> Callable[[Callable[[Stage], str]], Callable[[Stage], str]]:
    """Put a function on the list, under its own name."""

    def register(run: Callable[[Stage], str]) -> Callable[[Stage], str]:
        ATTACKS.append(Attack(run.__name__, expected, run))
        return run

    return register


def _let_in(stage: Stage, config: dict[str, Any], endpoint: str = "") -> str:
    """'' where a session is refused, or hears and reaches nothing."""
    before = len(stage.asked)
    try:
        session = stage.open(config, endpoint)
    except zenoh.ZError:
        return ""
    try:
        replies = list(session.get(key("quad5", "status"), timeout=HEARD))
        if replies or len(stage.asked) > before:
            return "was let in and answered"
        return ""
    finally:
        session.close()


# Who is let in


@attack("plain TCP is not let in")
def plain_tcp(stage: Stage) -> str:
    return _let_in(stage, {}, f"tcp/127.0.0.1:{stage.port}")


@attack("TLS without a certificate is not let in")
def no_certificate(stage: Stage) -> str:
    authority = str(stage.keys("anna").path(access.AUTHORITY))
    return _let_in(
        stage,
        {
            "transport/link/tls/root_ca_certificate": authority,
            "transport/link/tls/verify_name_on_connect": False,
        },
    )


@attack("an engineer of another authority is not let in")
def foreign_authority(stage: Stage) -> str:
    root = stage.folder / f"foreign-{time.monotonic_ns()}"
    make_keys(root, ["quad5"], [("bob", "engineer")])
    foreign = read_keys(root / "bob")
    trusting = {"transport/link/tls/root_ca_certificate": str(stage.keys("bob").path(access.AUTHORITY))}
    return _let_in(stage, {**tls(foreign), **trusting})


@attack("a certificate that has run out is not let in")
def expired_certificate(stage: Stage) -> str:
    name = f"late{time.monotonic_ns()}"
    make_keys(stage.root, people=[(name, "operator")], days=1e-9)
    try:
        time.sleep(1.1)  # certificates count whole seconds
        return _let_in(stage, tls(stage.keys(name)))
    finally:
        make_keys(stage.root, removed=[name])


@attack("somebody of whom the vehicle was not told reaches nothing, though the authority knows them")
def not_on_the_list(stage: Stage) -> str:
    name = f"new{time.monotonic_ns()}"
    make_keys(stage.root, people=[(name, "engineer")])
    try:
        return _let_in(stage, tls(stage.keys(name)))
    finally:
        make_keys(stage.root, removed=[name])


@attack("broken and silent handshakes cut nobody off who is connected, and others get in again afterwards")
def broken_handshakes(stage: Stage) -> str:
    noise = random.Random(1)
    silent = []
    try:
        with stage.link("anna") as link:
            for _ in range(20):
                with socket.create_connection(("127.0.0.1", stage.port), 2.0) as raw:
                    raw.sendall(noise.randbytes(noise.randint(1, 2000)))
            silent = [socket.create_connection(("127.0.0.1", stage.port), 2.0) for _ in range(40)]
            link.request("mission", {"trajectory": "hover"})
        for raw in silent:
            raw.close()
        # Zenoh waits 0.1 s after each broken handshake before it looks at the next caller.
        with Link(replace(link.settings, timeout=60.0)) as late:
            late.request("mission", {"trajectory": "hover"})
        return ""
    except InputError as error:
        return str(error)
    finally:
        for raw in silent:
            raw.close()


# What each role may do


@attack("each role reaches what it may, and nothing else")
def wrong_role(stage: Stage) -> str:
    wrong = []
    for who, role in PEOPLE[:3]:
        session = stage.intruder(who)
        try:
            for leaf, payload in ORDER.items():
                del stage.asked[:]
                # Access control drops the query: with a right it is answered at once, without it never.
                patience = 5.0 if may(role, leaf) else HEARD
                reached = bool(list(session.get(key("quad5", leaf), payload=payload, timeout=patience)))
                if (reached or (leaf, payload) in stage.asked) != may(role, leaf):
                    wrong.append(f"{role} {'reached' if reached else 'did not reach'} {leaf}")
        finally:
            session.close()
    return "; ".join(wrong)


@attack("a query for everything reaches no order")
def wildcards(stage: Stage) -> str:
    session = stage.intruder("eve")
    try:
        del stage.asked[:]
        for pattern in (
            "trueflight/quad5/*",
            "trueflight/**",
            "**",
            "*/quad5/mission",
            "trueflight/quad5/m*",
        ):
            try:
                list(
                    session.get(pattern, payload=ORDER["mission"], timeout=0.2, target=zenoh.QueryTarget.ALL)
                )
            except zenoh.ZError:
                continue
        asked = [leaf for leaf, _ in stage.asked if leaf in ("mission", "model")]
        return f"reached {asked}" if asked else ""
    finally:
        session.close()


@attack("nobody but the vehicle publishes under its name; poses come from operators and engineers alone")
def forged_publications(stage: Stage) -> str:
    wrong = []
    for who, role in PEOPLE[:3]:
        session = stage.intruder(who)
        try:
            list(session.get(key("quad5", "status"), timeout=2.0))
            del stage.heard[:]
            keys = [key("quad5", leaf) for leaf in NEEDS] + [f"{key('quad5', 'tick')}/@adv/pub/1/2/_"]
            keys += [key("other", "tick"), key("quad6", "status")]
            for one in keys:
                session.put(one, b"forged")
                session.delete(one)
            time.sleep(HEARD)
            heard = set(stage.heard)
            allowed = {key("quad5", "pose")} if may(role, "pose") else set()
            if heard != allowed:
                wrong.append(f"{role}: heard {sorted(heard)}, not {sorted(allowed)}")
        finally:
            session.close()
    return "; ".join(wrong)


@attack("a token, a queryable or ticks of an engineer reach no other ground station")
def forged_by_a_colleague(stage: Stage) -> str:
    return "; ".join(filter(None, (_forged(stage, mode) for mode in ("peer", "client"))))


def _forged(stage: Stage, mode: str) -> str:
    session = stage.open({**tls(stage.keys("bob")), "mode": mode})
    asked: list[str] = []
    ticks: list[bytes] = []
    try:
        kept = [session.liveliness().declare_token(key(name, "status")) for name in ("quad5", "ghost")] + [
            session.declare_queryable(
                key(name, leaf), lambda query: asked.append(str(query.key_expr)), complete=True
            )
            for name in ("quad5", "ghost")
            for leaf in ("mission", "status")
        ]
        with stage.link("anna") as link:
            link.session.declare_subscriber("trueflight/*/tick", lambda sample: ticks.append(b""))
            answer = link.request("mission", {"trajectory": "hover"})
            session.put(key("quad5", "tick"), b"forged")
            session.put(key("ghost", "tick"), b"forged")
            time.sleep(HEARD)
            names = companions(replace(link.settings, timeout=0.5))
        del kept
        if asked or not answer["accepted"] or ticks or names != ["quad5"]:
            return f"forger was asked {asked}, {len(ticks)} ticks came, companions {names}"
        return ""
    finally:
        session.close()


# Who stands in for the vehicle


def _impostor(stage: Stage, who: str) -> str:
    """'' where anna's ground station does not take somebody who listens for the vehicle quad5."""
    port = free_port()
    endpoint = f"tls/127.0.0.1:{port}"
    session = stage.open(
        {**tls(stage.keys(who)), "listen/endpoints": [endpoint], "connect/endpoints": []}, ""
    )
    asked: list[tuple[str, bytes]] = []
    fake = vehicle(session, "quad5", asked, stage.folder / "records")
    try:
        settings = Settings(connect=(endpoint,), timeout=1.5, keys=str(stage.root / "anna"))
        with Link(settings) as link:
            link.request("mission", {"trajectory": "hover"})
        return "the mission went to the impostor"
    except InputError:
        return f"the impostor was asked {asked}" if ("mission", ORDER["mission"]) in asked else ""
    finally:
        fake.close()


@attack("an engineer's certificate cannot stand in for the vehicle")
def engineer_as_vehicle(stage: Stage) -> str:
    return _impostor(stage, "bob")


@attack("another vehicle of the same authority cannot stand in for this one")
def other_vehicle(stage: Stage) -> str:
    return _impostor(stage, "vehicle-quad6")


# Models


def _sent(stage: Stage, onnx: bytes, signature: bytes | None, who: str = "bob") -> dict[str, Any]:
    session = stage.intruder(who)
    try:
        (reply,) = session.get(key("quad5", "model"), payload=onnx, attachment=signature, timeout=5.0)
        return dict(json.loads(reply.ok.payload.to_bytes()))
    finally:
        session.close()


def _signed(stage: Stage, onnx: bytes, who: str = "bob", name: str = "quad5") -> Signature:
    return sign(onnx, name, who, stage.keys(who).path(access.SIGNING_KEY))


def _refused(stage: Stage, onnx: bytes, signature: bytes | None) -> str:
    answer = _sent(stage, onnx, signature)
    left = list(stage.models.glob(f"{model_hash(onnx)}.*"))
    if answer["accepted"] or left:
        return f"accepted: {answer}, left on board: {left}"
    return ""


def _network() -> bytes:
    return b"\x08\x0a" + random.randbytes(200)


@attack("a model that an engineer signed for this vehicle is taken, once")
def signed_model_and_replay(stage: Stage) -> str:
    onnx = _network()
    signature = _signed(stage, onnx).to_json()
    first, again = _sent(stage, onnx, signature), _sent(stage, onnx, signature)
    if not first["accepted"] or again["accepted"] or "newer" not in again["reason"]:
        return f"first {first}, again {again}"
    return ""


@attack("an unsigned model is refused")
def unsigned_model(stage: Stage) -> str:
    return _refused(stage, _network(), None)


@attack("a model that was changed after it was signed is refused")
def tampered_model(stage: Stage) -> str:
    onnx = _network()
    signature = _signed(stage, onnx).to_json()
    return _refused(stage, onnx + b"\0", signature)


@attack("a signature for another vehicle is refused")
def signed_for_another_vehicle(stage: Stage) -> str:
    onnx = _network()
    return _refused(stage, onnx, _signed(stage, onnx, name="quad6").to_json())


@attack("a signature whose text was changed is refused, whatever was changed")
def edited_signature(stage: Stage) -> str:
    onnx = _network()
    other = _signed(stage, onnx, name="quad6")
    mine = _signed(stage, onnx, "carl")
    edits = (
        replace(other, vehicle="quad5"),
        replace(mine, signer="bob"),
        replace(mine, time_ns=mine.time_ns + 10**9),
        replace(_signed(stage, _network()), hash=mine.hash),
    )
    return "; ".join(filter(None, (_refused(stage, onnx, edit.to_json()) for edit in edits)))


@attack("somebody who is no engineer cannot sign")
def signed_by_nobody(stage: Stage) -> str:
    onnx = _network()
    key_file = stage.keys("bob").path(access.SIGNING_KEY)
    names = ("anna", "eve", "quad5", "", "root", "x" * 3000)
    return "; ".join(
        filter(None, (_refused(stage, onnx, sign(onnx, "quad5", name, key_file).to_json()) for name in names))
    )


@attack("a damaged signature is refused, and the service goes on")
def mutated_signature(stage: Stage) -> str:
    onnx, noise = _network(), random.Random(2)
    whole = _signed(stage, onnx).to_json()
    session = stage.intruder("bob")
    try:
        for _ in range(100):
            data = bytearray(whole)
            for _ in range(noise.randint(1, 4)):
                data[noise.randrange(len(data))] = noise.randrange(256)
            if noise.random() < 0.3:
                data = data[: noise.randrange(len(data))]
            if bytes(data) == whole:
                continue
            (reply,) = session.get(key("quad5", "model"), payload=onnx, attachment=bytes(data), timeout=5.0)
            answer = json.loads(reply.ok.payload.to_bytes())
            if answer["accepted"] or "internal" in answer["reason"]:
                return f"{bytes(data)!r}: {answer}"
        return ""
    finally:
        session.close()


# Without keys, on loopback


@attack("a forged liveliness token does not keep a mission from the true vehicle")
def forged_token(stage: Stage) -> str:
    with Open(stage, ("quad5",)) as there:
        forger = stage.open({}, f"tcp/127.0.0.1:{there.ports[0]}")
        stranger = stage.open(
            {"listen/endpoints": [f"tcp/127.0.0.1:{free_port()}"]}, f"tcp/127.0.0.1:{there.ports[0]}"
        )
        tokens = [
            session.liveliness().declare_token(key(name, "status"))
            for session in (forger, stranger)
            for name in ("quad5", "ghost", "quad5/status")
        ]
        try:
            for changes in ({}, {"name": "quad5"}):
                with Link(there.settings(**changes)) as link:
                    link.request("mission", {"trajectory": "hover"})
            return "" if there.missions() == [2] else f"missions {there.missions()}"
        except InputError as error:
            return str(error)
        finally:
            del tokens
            forger.close()
            stranger.close()


@attack("of two companions with one name neither is sent a mission, and both are named")
def two_of_one_name(stage: Stage) -> str:
    with Open(stage, ("quad5", "quad5")) as there:
        for changes in ({}, {"name": "quad5"}):
            try:
                with Link(there.settings(**changes)) as link:
                    link.request("mission", {"trajectory": "hover"})
                return f"sent: {there.missions()}"
            except InputError as error:
                if not all(str(port) in str(error) for port in there.ports) or "vehicle.toml" not in str(
                    error
                ):
                    return f"refused with: {error}"
        return f"sent: {there.missions()}" if any(there.missions()) else ""


@attack("a second companion of the name that comes later gets nothing of what was meant for the first")
def second_of_one_name_later(stage: Stage) -> str:
    with Open(stage, ("quad5",)) as there:
        listening = f"tcp/127.0.0.1:{free_port()}"
        with Link(there.settings(listen=(listening,))) as link:
            asked: list[tuple[str, bytes]] = []
            session = open_session(
                ZenohSettings(listen=(f"tcp/127.0.0.1:{free_port()}",), connect=(listening,))
            )
            late = vehicle(session, "quad5", asked, stage.folder / "records")
            try:
                time.sleep(HEARD)
                for _ in range(5):
                    link.request("mission", {"trajectory": "hover"})
            finally:
                late.close()
        if there.missions() != [5] or any(leaf == "mission" for leaf, _ in asked):
            return f"first {there.missions()}, second {asked}"
        return ""


@attack("of two vehicles the one that is named gets the mission, and without a name neither")
def two_vehicles(stage: Stage) -> str:
    with Open(stage, ("quad5", "quad6")) as there:
        with Link(there.settings(name="quad6")) as link:
            link.request("mission", {"trajectory": "hover"})
        if there.missions() != [0, 1]:
            return f"missions {there.missions()}"
        try:
            with Link(there.settings()) as link:
                return f"took {link.vehicle}"
        except InputError as error:
            return "" if "quad5, quad6" in str(error) and "--name" in str(error) else str(error)
