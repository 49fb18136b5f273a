"""Ticks read as columns are those that protobuf reads one by one, whatever their form."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.models.record_columns import VECTORS, TickColumns
from trueflight.models.record_pb2 import Tick

NUMBERS = st.sampled_from([0.0, -0.0, 1.5, -2.25, 1e300, float("nan"), float("inf")])
VECTOR = st.tuples(NUMBERS, NUMBERS, NUMBERS)


def unpacked_rotors(tick: bytes) -> bytes:
    """The tick with one more rotor speed, as a writer that does not pack them would have it."""
    return tick + b"\x91\x01" + np.float64(7.0).tobytes()


OTHER_WRITERS = {
    "as protobuf does": lambda data: data,
    "rotor speeds one by one": unpacked_rotors,
    "a field nobody knows": lambda data: data + b"\xf8\x3f\x05",
    "fields twice": lambda data: data + data,
    "a field of another type": lambda data: data + b"\x78\x05",
}


@st.composite
def ticks(draw: st.DrawFn) -> bytes:
    tick = Tick(
        vehicle_time_us=draw(st.integers(-5, 2**40)),
        host_time_ns=draw(st.integers(0, 2**63 - 1)),
        thrust_command=draw(NUMBERS),
        overtaken=draw(st.sampled_from([0, 1, 300, 2**32 - 1])),
        armed=draw(st.booleans()),
        setpoint_sent=draw(st.booleans()),
        phase=draw(st.sampled_from(["", "mission", "landing", "größer"])),
        guard=draw(st.sampled_from(["", "off", "tripped: späte Antwort"])),
        rotor_speed=draw(st.lists(NUMBERS, max_size=6)),
    )
    for name in draw(st.sets(st.sampled_from([*VECTORS, "quaternion"]))):
        vector = getattr(tick, name)
        vector.x, vector.y, vector.z = draw(VECTOR)
        vector.SetInParent()
    if draw(st.booleans()):
        tick.feedback.thrust = draw(NUMBERS)
        if draw(st.booleans()):
            tick.feedback.body_rate.y = draw(NUMBERS)
    return bytes(OTHER_WRITERS[draw(st.sampled_from(sorted(OTHER_WRITERS)))](tick.SerializeToString()))


def add(collected: TickColumns, data: list[bytes]) -> None:
    ends = list(itertools.accumulate(map(len, data), initial=3))  # some bytes before them that are no tick's
    collected.add(b"..." + b"".join(data), list(itertools.pairwise(ends)))


def columns_of(data: list[bytes]) -> dict[str, np.ndarray]:
    collected = TickColumns()
    add(collected, data)
    collected.settle()
    return collected.columns()


@settings(max_examples=60, deadline=None)
@given(st.lists(ticks(), min_size=1, max_size=12))
def test_columns_are_what_protobuf_reads(data: list[bytes]) -> None:
    columns = columns_of(data)
    for i, tick in enumerate(Tick.FromString(one) for one in data):
        for name in VECTORS:
            vector = getattr(tick, name)
            if name in columns:
                seen = (vector.x, vector.y, vector.z) if tick.HasField(name) else (np.nan,) * 3
                np.testing.assert_array_equal(columns[name][i], seen)
        q = tick.quaternion
        np.testing.assert_array_equal(columns["quaternion"][i], (q.w, q.x, q.y, q.z))
        rate = tick.feedback.body_rate
        np.testing.assert_array_equal(columns["feedback_body_rate"][i], (rate.x, rate.y, rate.z))
        np.testing.assert_array_equal(columns["feedback_thrust"][i], tick.feedback.thrust)
        np.testing.assert_array_equal(columns["thrust_command"][i], tick.thrust_command)
        assert columns["vehicle_time"][i] == tick.vehicle_time_us * 1e-6
        assert columns["host_time"][i] == tick.host_time_ns * 1e-9
        for name in ("overtaken", "armed", "setpoint_sent", "phase", "guard", "model"):
            assert columns[name][i] == getattr(tick, name)
        if "rotor_speed" in columns:
            speeds = list(tick.rotor_speed)[:4] if len(tick.rotor_speed) >= 4 else [np.nan] * 4
            # a speed that is no number is as good as none
            speeds = [np.nan] * 4 if np.any(np.isnan(speeds)) else speeds
            np.testing.assert_array_equal(columns["rotor_speed"][i], speeds)


@pytest.mark.parametrize("damage", [b"\x0a", b"\x7a\xff", b"\x9a\x01\x02\xff\xff", b"\x08" + b"\xff" * 11])
def test_ticks_before_a_damaged_one_are_kept(damage: bytes) -> None:
    good = [Tick(vehicle_time_us=i + 1, phase="mission").SerializeToString() for i in range(20)]
    collected = TickColumns()
    add(collected, [*good, good[0] + damage, *good])
    with pytest.raises(DecodeError):
        collected.settle()
    assert collected.count == 20
    assert list(collected.columns()["vehicle_time"]) == [(i + 1) * 1e-6 for i in range(20)]


def test_more_ticks_than_there_is_room_for_and_more_forms_than_are_looked_for() -> None:
    rng = np.random.default_rng(1)
    data = []
    for i in range(20_000):
        tick = Tick(vehicle_time_us=10_000 * i, thrust_command=0.5)
        for name in np.array(VECTORS)[rng.random(len(VECTORS)) < 0.5] if i % 10 == 0 else ():
            getattr(tick, name).x = 1.0
        data.append(tick.SerializeToString())
    columns = columns_of(data)
    assert list(columns["t"]) == [1e-6 * (10_000 * i) for i in range(20_000)]
    there = sum(int(np.isfinite(columns[name][:, 0]).sum()) for name in VECTORS if name in columns)
    assert there == sum(
        len(set(VECTORS) & {f.name for f, _ in Tick.FromString(one).ListFields()}) for one in data
    )
