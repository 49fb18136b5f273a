"""The network (11) for what no effect of a model explains: error acceleration from the features (28).

Source: Carvalho et al., ICUAS 2022, equations (10), (11) and (28): a few hidden layers of rectified linear units,
trained on the error acceleration. Here it learns what the linear model and the effects leave over.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from trueflight.models.contract import FEATURES, YAW_FEATURES
from trueflight.models.effect import Array, Effect, Motion, Stage
from trueflight.models.errors import InputError
from trueflight.models.outside import shown

Layer = tuple[Array, Array]
"""Weights (outputs, inputs) and biases (outputs,)."""
_Layer = tuple[np.ndarray, np.ndarray]

MOST_LAYERS = 8
WIDEST = 4096
"""A larger network in a file is a damaged file: ten times what any ablation here has tried."""


@dataclass(frozen=True, eq=False)
class Network:
    """A trained network: `features` (N, F) -> error acceleration (N, 3), heading frame, m/s².

    `features` are names of `models.contract`, in the order of the inputs; `centre`, `scale` (F,) normalise them;
    `layers` are weights (outputs, inputs) and biases, float32, with rectified linear units between; `output_scale`
    (3,) in m/s² turns the last layer's output into an acceleration. `low`, `high` (F,) are the range of the features
    in training; `margin` (F,), in the unit of each feature, is how far beyond it that feature alone takes the network
    to nothing, and None in files of before: they do not fade by themselves. `data_hash` tells the flights; `seed` and
    `recipe` how it was trained; `fit` holds the figures:
    `train_rms`, `validation_rms`, `noise_floor` and each by axis (m/s²), `epochs`, `seconds`.
    """

    features: tuple[str, ...]
    centre: np.ndarray
    scale: np.ndarray
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    output_scale: np.ndarray
    low: np.ndarray
    high: np.ndarray
    data_hash: str = ""
    seed: int = 0
    recipe: str = ""
    fit: Mapping[str, float] = field(default_factory=dict)
    margin: np.ndarray | None = None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Network) and network_table(self) == network_table(other)

    def __hash__(self) -> int:
        return hash(self.hash)

    @property
    def widths(self) -> tuple[int, ...]:
        """Units of the hidden layers."""
        return tuple(len(biases) for _, biases in self.layers[:-1])

    @property
    def parameters(self) -> int:
        """Trained numbers."""
        return sum(weights.size + biases.size for weights, biases in self.layers)

    @property
    def hash(self) -> str:
        """The network by its content: the first 12 hexadecimal digits of a SHA-256."""
        return hashlib.sha256(json.dumps(network_table(self), sort_keys=True).encode()).hexdigest()[:12]

    @property
    def label(self) -> str:
        """What people see: its hidden layers."""
        return "network " + "-".join(map(str, self.widths)) if self.widths else "network (linear)"


def propagate(layers: Sequence[Layer], x: Array) -> Array:
    """Normalised inputs `x` (N, F) through the `layers`, with rectified linear units between: (N, 3)."""
    xp = array_namespace(x)
    for index, (weights, biases) in enumerate(layers):
        if index:
            x = xp.clip(x, 0.0, None)
        x = xp.matmul(x, xp.permute_dims(xp.asarray(weights), (1, 0))) + xp.asarray(biases)
    return x


def error_acceleration_of(network: Network, features: Array) -> Array:
    """Error acceleration (N, 3), heading frame, m/s², of features (N, F) in the order of `network.features`; outside
    the training range what is left of it."""
    xp = array_namespace(features)
    kind = features.dtype
    centre, scale, out = (
        xp.asarray(np.asarray(a), dtype=kind) for a in (network.centre, network.scale, network.output_scale)
    )
    layers = [(xp.asarray(w, dtype=kind), xp.asarray(b, dtype=kind)) for w, b in network.layers]
    delta = propagate(layers, (features - centre) / scale) * out
    return delta if network.margin is None else delta * acting_share(network, features)[:, None]


def acting_share(network: Network, features: Array) -> Array:
    """Share (N,) of the network that acts at features (N, F): 1 in its training range, and less by how far outside
    each feature is, in its `margin`, until nothing is left."""
    xp = array_namespace(features)
    if network.margin is None:
        return 0.0 * features[:, 0] + 1.0
    low, high, margin = (
        xp.asarray(np.asarray(a), dtype=features.dtype) for a in (network.low, network.high, network.margin)
    )
    outside = xp.clip(low - features, 0.0, None) + xp.clip(features - high, 0.0, None)
    return xp.clip(1.0 - xp.sum(outside / margin, axis=-1), 0.0, None)


def folded_layers(network: Network, names: Sequence[str]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The layers, weights (K, F) and biases (K,) in float32, for raw features in the order of `names`, with all scaling
    inside: what is deployed.

    One that fades has four outputs: where the fourth is positive, the first three are multiplied by it, and nothing is
    left where it is not (`acting_share`). Features that the network does not know get weights of zero. Raises
    `InputError` where one that it needs is not among `names`.
    """
    absent = [n for n in network.features if n not in names]
    if absent:
        raise InputError(
            f"the network needs the features {', '.join(absent)}; they are not in {', '.join(names)}"
        )
    layers = [(np.asarray(w, dtype=float), np.asarray(b, dtype=float)) for w, b in network.layers]
    first, biases = layers[0]
    scaled = first / network.scale
    weights = np.zeros((len(first), len(names)))
    weights[:, [list(names).index(n) for n in network.features]] = scaled
    layers[0] = (weights, biases - scaled @ network.centre)
    if network.margin is not None and len(layers) == 1:
        layers = _with_hidden_layer(*layers[0])
    last, biases = layers[-1]
    layers[-1] = (last * network.output_scale[:, None], biases * network.output_scale)
    if network.margin is not None:
        layers = _beside(layers, _share_layers(network, names, len(layers)))
    return [(w.astype(np.float32), b.astype(np.float32)) for w, b in layers]


def _with_hidden_layer(weights: np.ndarray, biases: np.ndarray) -> list[_Layer]:
    """One layer as two with rectified units between that leave it a line: each input's positive part, and its negative
    one."""
    whole = np.eye(weights.shape[1])
    halves = np.concatenate([whole, -whole]), np.zeros(2 * len(whole))
    return [halves, (np.concatenate([weights, -weights], axis=1), biases)]


def _share_layers(network: Network, names: Sequence[str], count: int) -> list[_Layer]:
    """`acting_share` of raw features in the order of `names` as `count` layers (2 at least) with rectified units
    between, before its own rectification: how far each feature is below and above its range, their sum, 1 less it."""
    f = len(network.features)
    pick = np.zeros((f, len(names)))
    pick[range(f), [list(names).index(n) for n in network.features]] = 1.0 / np.asarray(network.margin, float)
    first = np.concatenate([-pick, pick])
    ends = np.concatenate([network.low, -network.high]) / np.tile(np.asarray(network.margin, float), 2)
    layers: list[_Layer] = [(first, ends)]
    for _ in range(count - 2):
        layers.append((np.ones((1, len(layers[-1][1]))), np.zeros(1)))
    layers.append((-np.ones((1, len(layers[-1][1]))), np.ones(1)))
    return layers


def _beside(layers: list[_Layer], others: list[_Layer]) -> list[_Layer]:
    """Two chains of layers with the same inputs as one, the outputs of the second behind those of the first."""
    (w, b), (v, c) = layers[0], others[0]
    joined = [(np.concatenate([w, v]), np.concatenate([b, c]))]
    for (w, b), (v, c) in zip(layers[1:], others[1:], strict=True):
        whole = np.zeros((len(b) + len(c), w.shape[1] + v.shape[1]))
        whole[: len(b), : w.shape[1]], whole[len(b) :, w.shape[1] :] = w, v
        joined.append((whole, np.concatenate([b, c])))
    return joined


def features_of_motion(motion: Motion, names: Sequence[str]) -> Array:
    """The features (N, F) of a motion before the air acts on it, in the order of `names`.

    `T` is the thrust (N) that acts after the known delay and lag, so that what is learnt has no memory: at the
    moment of a command it is the command. Voltage is nominal where none was recorded.

    Raises `InputError` where the flight lacks attitude, velocity or height.
    """
    xp, r, v = array_namespace(motion.thrust), motion.rotation, motion.air_velocity
    if r is None or v is None or motion.height is None:
        raise InputError(
            "the model's network needs position, velocity and attitude; add the columns position_*, velocity_* and "
            "quaternion_*, or compare a version without a network"
        )
    nominal = motion.vehicle.nominal_voltage
    columns = {
        "z": motion.height,
        "cos_phi": r[:, 1, 1],
        "sin_phi": -r[:, 1, 2],
        "cos_theta": r[:, 0, 0],
        "sin_theta": -r[:, 2, 0],
        "vx": v[:, 0],
        "vy": v[:, 1],
        "vz": v[:, 2],
        "u_batt": 0.0 * motion.thrust + nominal if motion.voltage is None else motion.voltage,
        "T": motion.command * motion.vehicle.mass,
        "cos_psi": motion.cos_yaw,
        "sin_psi": motion.sin_yaw,
    }
    return xp.stack([columns[n] for n in names], axis=-1)


def network_effect(network: Network) -> Effect:
    """The network as the last link of a chain of effects: it acts on the acceleration, whatever the wind."""

    def formula(motion: Motion) -> Motion:
        delta = error_acceleration_of(network, features_of_motion(motion, network.features))
        return motion.with_(thrust_acceleration=motion.thrust_acceleration + delta)

    return Effect(
        name="network",
        title="what no effect of the model explains, learnt",
        stage=Stage.REMAINDER,
        formula=formula,
        parameters=(),
        needs=("position", "velocity", "quaternion", "thrust_command"),
        manoeuvre="whatever the vehicle will fly: a network knows nothing outside its training range",
        citation="Carvalho et al. 2022, equation (11)",
    )


# --- on disk --------------------------------------------------------------------------------------------------------


def network_table(network: Network) -> dict[str, Any]:
    """The network as JSON holds it: arrays as base64 of little-endian float32, layers by their sizes."""
    return {
        "features": list(network.features),
        "sizes": [len(network.features), *network.widths, 3],
        "centre": _encode(network.centre),
        "scale": _encode(network.scale),
        "layers": [{"weights": _encode(w), "biases": _encode(b)} for w, b in network.layers],
        "output_scale": _encode(network.output_scale),
        "low": _encode(network.low),
        "high": _encode(network.high),
        **({} if network.margin is None else {"margin": _encode(network.margin)}),
        "data_hash": network.data_hash,
        "seed": network.seed,
        "recipe": network.recipe,
        "fit": dict(network.fit),
    }


def network_from_table(table: object, where: str) -> Network:
    """Check and read a network's JSON; `where` names it in errors. Raises `InputError` for whatever is wrong."""
    if not isinstance(table, dict):
        raise InputError(
            f"{where}: must be an object, not {type(table).__name__}; restore the file from a copy"
        )
    names, sizes = _names(table, where), _sizes(table, where)
    if len(names) != sizes[0]:
        raise InputError(
            f"{where}: {len(names)} features but {sizes[0]} inputs; restore the file from a copy"
        )
    layers = table.get("layers")
    if not isinstance(layers, list) or len(layers) != len(sizes) - 1:
        raise InputError(f"{where}: 'layers' must hold {len(sizes) - 1} layers; restore the file from a copy")
    read = []
    for number, layer in enumerate(layers):
        if not isinstance(layer, dict):
            raise InputError(f"{where}: layer {number} is not an object; restore the file from a copy")
        inputs, outputs = sizes[number : number + 2]
        at = f"{where}: layer {number}"
        read.append(
            (_decode(layer, "weights", at, (outputs, inputs)), _decode(layer, "biases", at, (outputs,)))
        )
    f = (len(names),)
    network = Network(
        features=names,
        centre=_decode(table, "centre", where, f),
        scale=_decode(table, "scale", where, f),
        layers=tuple(read),
        output_scale=_decode(table, "output_scale", where, (3,)),
        low=_decode(table, "low", where, f),
        high=_decode(table, "high", where, f),
        data_hash=_typed(table, "data_hash", where, str, ""),
        seed=_typed(table, "seed", where, int, 0),
        recipe=_typed(table, "recipe", where, str, ""),
        fit=_typed(table, "fit", where, dict, {}),
        margin=_decode(table, "margin", where, f) if "margin" in table else None,
    )
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in network.fit.values()):
        raise InputError(f"{where}: 'fit' is {shown(dict(network.fit))}, not an object of numbers")
    if not np.all(network.scale > 0.0):
        raise InputError(f"{where}: 'scale' must be positive; restore the file from a copy")
    if network.margin is not None and not np.all(network.margin > 0.0):
        raise InputError(f"{where}: 'margin' must be positive; restore the file from a copy")
    if not np.all(network.low <= network.high):
        raise InputError(
            f"{where}: the training range 'low' to 'high' is empty; restore the file from a copy"
        )
    return network


def _names(table: dict[str, Any], where: str) -> tuple[str, ...]:
    names, known = table.get("features"), {**FEATURES, **YAW_FEATURES}
    if (
        not isinstance(names, list)
        or not names
        or any(not isinstance(n, str) or n not in known for n in names)
    ):
        raise InputError(f"{where}: 'features' are {shown(names)}; known are {', '.join(known)}")
    return tuple(names)


def _sizes(table: dict[str, Any], where: str) -> list[int]:
    sizes = table.get("sizes")
    fine = (
        isinstance(sizes, list)
        and 2 <= len(sizes) <= MOST_LAYERS + 1
        and all(type(s) is int and 1 <= s <= WIDEST for s in sizes)
        and sizes[-1] == 3
    )
    if not fine:
        raise InputError(
            f"{where}: 'sizes' is {shown(sizes)}; it must be inputs, hidden layers and 3 outputs"
        )
    return list(sizes)  # type: ignore[arg-type]


def _typed(table: dict[str, Any], key: str, where: str, kind: type, default: Any) -> Any:
    value = table.get(key, default)
    if type(value) is not kind:
        raise InputError(f"{where}: '{key}' is {shown(value)}, not of the kind {kind.__name__}")
    return value


def _encode(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f4").tobytes()).decode("ascii")


def _decode(table: dict[str, Any], key: str, where: str, shape: tuple[int, ...]) -> np.ndarray:
    try:
        data = base64.b64decode(table[key], validate=True)
    except (KeyError, TypeError, ValueError, binascii.Error):
        raise InputError(f"{where}: '{key}' is missing or damaged; restore the file from a copy") from None
    if len(data) != 4 * int(np.prod(shape)):
        raise InputError(
            f"{where}: '{key}' holds {len(data) // 4} numbers where {shape} are expected; restore the file from a copy"
        )
    array = np.frombuffer(data, dtype="<f4").reshape(shape).astype(np.float32)
    if not np.all(np.isfinite(array)):
        raise InputError(f"{where}: '{key}' holds numbers that are not finite; restore the file from a copy")
    return array
