"""Where the processor time of one control tick goes, without wire and waiting.

    python benchmarks/companion_tick.py [--models FOLDER] [--ticks 4000] [--rounds 5] [--json]

A simulated vehicle is flown in-process at 100 Hz of its own time through the whole of what a companion does with an
odometry message: the JSON that MAVSDK hands over is read (`parse`), the flight decides (`decide`), the setpoint is
written (`setpoint`); then, after it has left, the watch over the flight (`watch`) and the record's tick (`record`).
Each stage is timed by its thread's processor time, and the median over all ticks is told in us. `before` is the sum of
the stages that stand between odometry and setpoint. `--models` holds ONNX files by the names of `correction_models.py`
(made there first where the folder is empty): each flies `corrected`. The last rows are the models alone: the rows of
features as a tick asks for, by ONNX Runtime and as the companion runs them.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from trueflight.companion.flight import FlightStateMachine
from trueflight.companion.latest import Latest
from trueflight.companion.law.control import ControlLaw
from trueflight.companion.law.guard import Guard
from trueflight.companion.mission import Mission
from trueflight.companion.odometry import odometry_from_wire, setpoint_on_wire, without_covariance
from trueflight.companion.stopping import Safety
from trueflight.companion.tick import make_tick
from trueflight.models.design import load_design
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.simulator import Simulator

VEHICLE = Path(__file__).parents[1] / "models" / "vehicles" / "quad5" / "vehicle.toml"
KINDS = ("effects", "network", "both")
STAGES = ("parse", "decide", "setpoint", "watch", "record")
BEFORE = ("parse", "decide", "setpoint")
PHYSICS_STEPS = 5  # of 2 ms: 100 Hz


def _odometry_text(estimate: Any) -> str:
    """An ODOMETRY message as MAVSDK's `mavlink_direct` hands it over, NED and FRD, 32-bit numbers printed as 64-bit."""
    import numpy as np

    def f(value: float) -> float:
        return float(np.float32(value))

    (x, y, z), (u, v, w), (p, q, r) = estimate.position, estimate.velocity, estimate.angular_velocity
    a, b, c, d = estimate.quaternion
    half = math.sqrt(0.5)
    attitude = [f(half * (a + d)), f(half * (b + c)), f(half * (b - c)), f(half * (a - d))]
    nothing = ",".join(["null"] + ["0.0"] * 20)
    return (
        f'{{"message_id":331,"message_name":"ODOMETRY","child_frame_id":1,"estimator_type":8,"frame_id":1,'
        f'"pitchspeed":{f(-q)!r},"pose_covariance":[{nothing}],"q":{attitude!r},"quality":100,"reset_counter":0,'
        f'"rollspeed":{f(p)!r},"time_usec":{estimate.time_us},"velocity_covariance":[{nothing}],'
        f'"vx":{f(v)!r},"vy":{f(u)!r},"vz":{f(-w)!r},"x":{f(y)!r},"y":{f(x)!r},"yawspeed":{f(-r)!r},"z":{f(-z)!r}}}'
    )


def _imu_text(estimate: Any) -> str:
    (x, y, z), (p, q, r) = estimate.specific_force, estimate.angular_velocity
    return (
        f'{{"message_id":105,"message_name":"HIGHRES_IMU","abs_pressure":955.977294921875,"diff_pressure":0.0,'
        f'"fields_updated":8191,"id":0,"pressure_alt":488.04766845703125,"temperature":25.0,'
        f'"time_usec":{estimate.time_us},"xacc":{x!r},"xgyro":{p!r},"xmag":0.010245505720376968,"yacc":{-y!r},'
        f'"ygyro":{-q!r},"ymag":-0.20945776998996735,"zacc":{-z!r},"zgyro":{-r!r},"zmag":0.4302586019039154}}'
    )


def tick_costs(onnx: bytes | None, ticks: int) -> dict[str, float]:
    """Median processor time of each stage, us, in a flown lemniscate; with a model `corrected`."""
    vehicle = load_vehicle(VEHICLE)
    law = ControlLaw(vehicle, load_design(VEHICLE.with_name("design.json"), vehicle))
    guard, controller = None, "lqr"
    if onnx is not None:
        guard, controller = Guard(_open(onnx, vehicle).watched()), "corrected"
    flight = FlightStateMachine(law, Safety())
    flight.prepare(Mission("1", trajectory("lemniscate", laps=100.0, speed=2.0), controller, guard=guard))
    flight.take_off()
    simulator = Simulator(vehicle, (), 1)
    simulator.start_in_hover((0.0, 0.0, simulator.world.standing_height + 0.1))
    latest = Latest(battery_voltage=16.0, flight_mode="OFFBOARD", armed=True, rotor_speed=(900.0,) * 4)
    clock = time.thread_time_ns
    spent: dict[str, list[int]] = {stage: [] for stage in STAGES}
    for number in range(ticks):
        estimate = simulator.estimate()
        text, latest.imu, arrived = _odometry_text(estimate), _imu_text(estimate), time.monotonic_ns()
        begin = clock()
        fields = json.loads(without_covariance(text))
        fields["arrived"] = arrived
        odometry = odometry_from_wire(fields)
        assert odometry is not None
        parsed = clock()
        outcome = flight.tick(odometry, latest)
        allowed = flight.may_leave(outcome, 0.0)
        decided = clock()
        thrust, rates = 0.0, (0.0, 0.0, 0.0)
        if allowed:
            assert outcome.step is not None
            thrust, rates = outcome.step.thrust_command, outcome.step.command.body_rate
            setpoint_on_wire(1, odometry.vehicle_time_us, thrust, rates)
        written = clock()
        flight.watch(latest)
        watched = clock()
        make_tick(odometry, latest, outcome, 0.0).SerializeToString()
        recorded = clock()
        if outcome.phase == "mission":
            moments = (begin, parsed, decided, written, watched, recorded)
            for stage, first, second in zip(STAGES, moments, moments[1:], strict=False):
                spent[stage].append(second - first)
        for _ in range(PHYSICS_STEPS):
            simulator.step(thrust, *rates)
        assert number < 10 or flight.phase in ("takeoff", "mission"), flight.outcome
    assert guard is None or guard.status == "active", guard.status
    return {stage: 1e-3 * statistics.median(spent[stage]) for stage in STAGES}


def _open(onnx: bytes, vehicle: Any) -> Any:
    from trueflight.companion.law.model_check import check_model

    verdict = check_model(onnx, vehicle)
    assert verdict.model is not None, verdict.reason
    return verdict.model


def model_costs(onnx: bytes, runs: int = 3000) -> dict[str, float]:
    """Processor time of a tick's rows of features, us: the median of many runs, by ONNX Runtime alone and as flown."""
    import numpy as np
    import onnxruntime

    from trueflight.companion.law.inference import LOOK_ROWS

    model = _open(onnx, load_vehicle(VEHICLE))
    middle = [0.5 * (one.low + one.high) for one in model.info.features]
    rows = [[value + 0.01 * i for value in middle] for i in range(LOOK_ROWS)]
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(onnx, options, providers=["CPUExecutionProvider"])
    given, answer = np.array(rows, dtype=np.float32), np.zeros((LOOK_ROWS, 3), dtype=np.float32)
    binding = session.io_binding()
    binding.bind_input("features", "cpu", 0, np.float32, given.shape, given.ctypes.data)
    binding.bind_output("delta", "cpu", 0, np.float32, answer.shape, answer.ctypes.data)
    return {
        "bare": _median(lambda: session.run_with_iobinding(binding), runs),
        "flown": _median(lambda: model.rows(rows), runs),
    }


def _median(run: Any, runs: int) -> float:
    spent = []
    for _ in range(runs):
        begin = time.thread_time_ns()
        run()
        spent.append(time.thread_time_ns() - begin)
    return 1e-3 * statistics.median(spent)


def measure(models: Path, ticks: int, rounds: int) -> list[dict[str, Any]]:
    """One row a program: the least median of several rounds, by turns."""
    files = {name: (models / f"{name}.onnx").read_bytes() for name in KINDS}
    programs: dict[str, bytes | None] = {"plain": None, **files}
    found: dict[str, list[dict[str, float]]] = {name: [] for name in programs}
    for _ in range(rounds):
        for name, onnx in programs.items():
            found[name].append(tick_costs(onnx, ticks))
    rows: list[dict[str, Any]] = []
    for name, each in found.items():
        row: dict[str, Any] = {stage: min(one[stage] for one in each) for stage in STAGES}
        rows.append({"program": name, **row, "before": sum(row[stage] for stage in BEFORE)})
    for row in rows[1:]:
        row |= model_costs(files[row["program"]])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", type=Path, default=Path("build/correction_models"))
    parser.add_argument("--ticks", type=int, default=4000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    a = parser.parse_args()
    a.models.mkdir(parents=True, exist_ok=True)
    if not (a.models / "both.onnx").exists():
        script = Path(__file__).with_name("correction_models.py")
        subprocess.run([sys.executable, script, a.models], check=True)
    rows = measure(a.models, a.ticks, a.rounds)
    if a.json:
        print(json.dumps(rows))
        return
    plain = rows[0]["before"]
    for row in rows:
        stages = "  ".join(f"{stage} {row[stage]:5.1f}" for stage in STAGES)
        line = f"{row['program']:8s} {stages}  before {row['before']:6.1f} us ({row['before'] / plain:.2f} x plain)"
        if "bare" in row:
            line += f"  rows of a tick: bare {row['bare']:.1f}, flown {row['flown']:.1f} us"
        print(line)


if __name__ == "__main__":
    main()
