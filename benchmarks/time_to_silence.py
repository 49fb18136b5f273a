"""How soon a companion in trouble falls silent, and what the autopilot then does.

    python benchmarks/time_to_silence.py [--rounds 3] [--json]

A companion flies the simulated vehicle; in flight its control thread falls asleep or spins for ever, or
the process is stopped (SIGSTOP) or killed (SIGKILL). On the wire between them stands a wiretap. Times are
from the trouble to the last setpoint that passed, and to the moment the vehicle's heartbeat says that it
left Offboard (COM_OF_LOSS_T is 1 s, heartbeats come at 10 Hz). For comparison, a program that sends its
setpoints through MAVSDK's offboard plugin hangs in the same way: the plugin goes on sending.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "companion"))

from rig import Bridge, Companion, Process, Wiretap, wait_for

HANGS = """
import signal, time
from trueflight.companion.law.control import ControlLaw
hung = []
signal.signal(signal.SIGUSR1, lambda *_: hung.append(1))
step = ControlLaw.step
def hanging(self, *arguments, **named):
    while hung:
        {rest}
    return step(self, *arguments, **named)
ControlLaw.step = hanging
"""
TROUBLES = {
    "control thread asleep": (signal.SIGUSR1, "time.sleep(1.0)"),
    "control thread spinning": (signal.SIGUSR1, "pass"),
    "SIGSTOP": (signal.SIGSTOP, "pass"),
    "SIGKILL": (signal.SIGKILL, "pass"),
}
PLUGIN = """
import signal, sys, time, mavsdk
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.offboard import Offboard
from mavsdk.plugins.offboard.offboard import AttitudeRate
from mavsdk.plugins.telemetry import Telemetry
mavsdk.log_subscribe(lambda level, text, file, line: True)
wire = Mavsdk(Configuration.create_with_component_type(mavsdk.ComponentType.COMPANION_COMPUTER))
wire.add_any_connection(sys.argv[1])
system = wire.first_autopilot(20.0)
offboard, telemetry, hung = Offboard(system), Telemetry(system), []
signal.signal(signal.SIGUSR1, lambda *_: hung.append(1))
def answer(odometry, _):
    while hung:
        time.sleep(1.0)
    offboard.set_attitude_rate(AttitudeRate(0, 0, 0, 0.1))
telemetry.subscribe_odometry(answer)
telemetry.set_rate_odometry(100.0)
time.sleep(1.0)
offboard.start()
print("ready", flush=True)
while True:
    time.sleep(0.1)
"""


def companion_in(trouble: str) -> dict[str, float]:
    """One flight that ends in this trouble; s to the last setpoint and to the end of Offboard."""
    number, rest = TROUBLES[trouble]
    tap = Wiretap()
    bridge = Bridge(tap.port)
    with tempfile.TemporaryDirectory() as folder:
        companion = Companion(Path(folder), tap.companion_port, before=HANGS.format(rest=rest))
        try:
            companion.fly(trajectory="hover", parameters={"duration": 600.0})
            companion.phase("mission")
            begin = time.monotonic()
            companion.send(number)
            wait_for(lambda: tap.mode != "OFFBOARD", "the failsafe")
            left = time.monotonic() - begin
            time.sleep(2.0)
            return {"silent": tap.silence(begin), "left_offboard": left}
        finally:
            companion.end(signal.SIGKILL)
            bridge.end()
            tap.close()


def plugin() -> dict[str, float]:
    """The same hang in a program on the offboard plugin; s for which setpoints still came in the 3 s watched."""
    tap = Wiretap()
    bridge = Bridge(tap.port)
    program = Process(["-c", PLUGIN, f"udpin://127.0.0.1:{tap.companion_port}"])
    try:
        program.ready()
        wait_for(lambda: tap.mode == "OFFBOARD", "Offboard")
        begin = time.monotonic()
        program.send(signal.SIGUSR1)
        time.sleep(3.0)
        return {
            "silent": tap.silence(begin),
            "left_offboard": float("nan" if tap.mode == "OFFBOARD" else "0"),
        }
    finally:
        program.end(signal.SIGKILL)
        bridge.end()
        tap.close()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    a = parser.parse_args()
    rows = {trouble: [companion_in(trouble) for _ in range(a.rounds)] for trouble in TROUBLES}
    compared = plugin()
    if a.json:
        print(json.dumps({"companion": rows, "offboard_plugin_asleep": compared}))
        return
    for trouble, rounds in rows.items():
        silent = max(one["silent"] for one in rounds)
        left = [one["left_offboard"] for one in rounds]
        print(
            f"{trouble:25s} silent after {1e3 * silent:5.1f} ms at most, left Offboard after "
            f"{min(left):.2f} to {max(left):.2f} s"
        )
    print(f"offboard plugin, asleep   still sending {compared['silent']:.2f} s later, of 3 s watched")


if __name__ == "__main__":
    main()
