"""The contract of a deployed model: one ONNX file with metadata, and the keys and payloads on Zenoh."""

from __future__ import annotations

import hashlib

CONTRACT_VERSION = "1"

LQR, LQR_INTEGRAL, CORRECTED = "lqr", "lqr_integral", "corrected"
CORRECTED_ADAPTIVE = "corrected_adaptive"
"""`corrected`, with a model whose numbers are learnt anew while it flies."""
WITH_MODEL = (CORRECTED, CORRECTED_ADAPTIVE)
"""Controllers that fly with a deployed model."""
INDI, L1_ADAPTIVE, GEOMETRIC, PX4_CASCADE = "indi", "l1_adaptive", "geometric", "px4_cascade"
CONTROLLERS = (LQR, LQR_INTEGRAL, CORRECTED, CORRECTED_ADAPTIVE, INDI, L1_ADAPTIVE, GEOMETRIC, PX4_CASCADE)
"""What a mission can be flown with: the cascade, the cascade with an integral, the cascade with its correction; to be
compared with them, controllers after other papers. `models.controllers` has those of installed packages beside them."""

INPUT_NAME, OUTPUT_NAME = "features", "delta"
"""float32 [N, F] in, float32 [N, 3] out: error acceleration in m/s², heading frame."""
PARAMETERS_NAME, SENSITIVITY_NAME = "parameters", "sensitivity"
"""Of a model that learns in flight: float32 [N, P] in, beside the features; float32 [N, 3 P] out: the derivative of the
three accelerations along the first parameter, then along the second, and so on."""

FEATURES: dict[str, str] = {
    "z": "m",
    "cos_phi": "1",
    "sin_phi": "1",
    "cos_theta": "1",
    "sin_theta": "1",
    "vx": "m/s",
    "vy": "m/s",
    "vz": "m/s",
    "u_batt": "V",
    "T": "N",
}
"""Features (28) of the paper in their order, with units. `vx, vy` in the heading frame, `z` above ground."""

YAW_FEATURES: dict[str, str] = {"cos_psi": "1", "sin_psi": "1"}
"""Appended for a model that needs yaw (wind)."""

LONGEST_WORD = 200
"""Characters of metadata that are a name or a hash: they are shown to people, and stand in events and records."""

# Keys of the ONNX file's custom metadata; every value is a string, lists and objects as JSON.
KEY_CONTRACT = "trueflight.contract"  # CONTRACT_VERSION
KEY_NAME = "name"
KEY_VERSION = "version"
KEY_VEHICLE = "vehicle"  # {"name": str, "mass": kg, "hover_thrust": 1}
KEY_FEATURES = "features"  # [{"name", "unit", "low", "high"}], the range seen in training
KEY_CHAIN = "chain"  # [{"effect": name, "parameters": {name: value}}], in order
KEY_DATA_HASH = "data_hash"  # SHA-256 of the data, of a few flights theirs with + between
KEY_GOLDEN_FEATURES = "golden_features"  # [[F floats] x at least 3]
KEY_GOLDEN_DELTA = (
    "golden_delta"  # [[3 floats] x as many]; the companion evaluates them again, within GOLDEN_TOLERANCE
)
KEY_ACTUATION = "actuation"
"""Optional: what was measured of the path from command to motion, {name: value} of `ACTUATION_LIMITS`."""
ACTUATION_LIMITS: dict[str, float] = {
    "rate_delay": 0.1,  # s, of the roll and pitch rate loop
    "rate_lag": 0.15,  # s
    "rate_integral": 20.0,  # 1/s, ratio of the rate loop's integral to its proportional gain
    "thrust_delay": 0.1,  # s
    "thrust_lag": 0.15,  # s
}
"""The greatest value of each number; beyond it no look-ahead can help, and none is accepted."""
KEY_ADAPTIVE = "adaptive"
"""Optional: what may be learnt in flight, a list of the fields of `models.learnable.Learnable`, in the order of the
graph's parameters. With it go the next three keys."""
KEY_NOISE = "noise"  # [3 floats], m/s²: what the model leaves of the flights it was exported with, low-passed
KEY_GOLDEN_PARAMETERS = "golden_parameters"  # [[P floats] x as many as golden features]
KEY_GOLDEN_SENSITIVITY = "golden_sensitivity"  # [[3 P floats] x as many]
REQUIRED_KEYS = (
    KEY_CONTRACT,
    KEY_NAME,
    KEY_VERSION,
    KEY_VEHICLE,
    KEY_FEATURES,
    KEY_CHAIN,
    KEY_DATA_HASH,
    KEY_GOLDEN_FEATURES,
    KEY_GOLDEN_DELTA,
)
GOLDEN_TOLERANCE = 1e-3  # m/s², absolute


REQUEST_BYTES: dict[str, int] = {
    "status": 1 << 10,
    "mission": 1 << 20,
    "model": 4 << 20,
    "record": 4 << 10,
    "pose": 4 << 10,
}
"""The most bytes that a message on each key may have; what is larger is refused before anybody looks at it."""
ATTACHED_BYTES = 4 << 10
"""The most bytes attached to a request: a signature has a few hundred."""
SELECTOR_CHARACTERS = 256
"""The most characters of a selector's parameters."""


def too_large(leaf: str, size: int) -> str:
    """'' where a message of `size` bytes may be sent on this key, otherwise the reason why it is refused."""
    most = REQUEST_BYTES[leaf]
    return "" if size <= most else f"the {leaf} message has {size} bytes; at most {most} are accepted"


def model_hash(onnx: bytes) -> str:
    """Name of a model by its content: the first 12 hexadecimal digits of the file's SHA-256."""
    return hashlib.sha256(onnx).hexdigest()[:12]


def key(vehicle: str, leaf: str) -> str:
    """Zenoh key `trueflight/<vehicle>/<leaf>`.

    Leaves: `tick` (protobuf Tick), `event` (protobuf Event), `status` (liveliness token, and a query answered with
    JSON), `mission` (query with JSON), `model` (query, ONNX bytes as payload), `record` (query; JSON list, or the
    bytes of one record), `pose` (put by mocap or vision, JSON: `models.pose`). Queries are answered with JSON
    `{"accepted": bool, "reason": str, ...}`.
    """
    return f"trueflight/{vehicle}/{leaf}"
