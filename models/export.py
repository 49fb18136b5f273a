"""A model as one ONNX file with its contract in the metadata. Needs torch; on the ground only."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import torch

from trueflight.models import contract, dual
from trueflight.models.adaptive import adaptive as with_learnables
from trueflight.models.effect import Stage
from trueflight.models.export_graph import simplify
from trueflight.models.features import feature_matrix, feature_names, features_of_flight
from trueflight.models.flight import Flight
from trueflight.models.lag import lagged
from trueflight.models.learnable import Learnable
from trueflight.models.model import Model
from trueflight.models.network import Network, folded_layers
from trueflight.models.prediction import (
    apply_effects,
    error_acceleration,
    motion_of_features,
    motion_of_flight,
    specific_force,
)

GOLDEN = 8
"""Golden vectors in each file."""
SMOOTHING = 0.2
"""s: time constant of the low-pass behind which the noise of an adaptive model is told, as a shadow's
(`companion.shadow`)."""
LEAST_NOISE = 0.03
"""m/s²: below it no model is believed to be, and what says so has been fitted to its own noise."""


class Correction(torch.nn.Module):
    """`delta` (N, 3) of features (N, F): effects and network minus the hover linearisation, heading frame, m/s².

    All scaling of the network is inside its weights, and raw features go in: a few microseconds of inference.
    """

    def __init__(self, model: Model, names: tuple[str, ...]) -> None:
        super().__init__()
        self.names, self.vehicle = names, model.vehicle
        self.chain = [
            (effect, {k: float(v) for k, v in values.items()})
            for effect, values in model.effect_chain()
            if effect.exports and effect.stage is not Stage.SENSOR
        ]
        self.network: torch.nn.Module | None = None
        if model.network is not None:
            self.network = network_module(folded_layers(model.network, names))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Error acceleration of each row."""
        learnt = None if self.network is None else self.network(features)
        if not self.chain and learnt is not None:
            return learnt
        columns = {name: features[:, i] for i, name in enumerate(self.names)}
        known: Any = error_acceleration(motion_of_features(columns, self.vehicle), self.chain)
        return known if learnt is None else known + learnt


class Adaptive(Correction):
    """`delta` (N, 3) of features (N, F) and parameters (N, P), and its derivative along each parameter (N, 3 P): the
    effects' own formulas, differentiated as they stand."""

    def __init__(self, model: Model, names: tuple[str, ...], learnables: Sequence[Learnable]) -> None:
        super().__init__(model, names)
        self.learnables = tuple(learnables)

    def forward(  # type: ignore[override]
        self, features: torch.Tensor, parameters: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Error acceleration of each row, and its derivatives."""
        free = dict(
            zip(
                [(one.effect, one.parameter) for one in self.learnables],
                dual.parameters([parameters[:, k] for k in range(len(self.learnables))]),
                strict=True,
            )
        )
        chain = [
            (effect, {name: free.get((effect.name, name), value) for name, value in values.items()})
            for effect, values in self.chain
        ]
        known: Any = error_acceleration(
            motion_of_features(
                {name: dual.fixed(features[:, i], len(free)) for i, name in enumerate(self.names)},
                self.vehicle,
            ),
            chain,
        )
        delta = known.value if self.network is None else known.value + self.network(features)
        nothing = 0.0 * features[:, 0]
        slopes = [nothing if slope is None else slope[:, axis] for slope in known.slopes for axis in range(3)]
        return delta, torch.stack(slopes, dim=-1)


class Fading(torch.nn.Module):
    """A network whose fourth output, where it is positive, multiplies the first three; nothing is left elsewhere."""

    def __init__(self, layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
        super().__init__()
        (weights, biases), hidden = layers[-1], sequential(layers[:-1])
        self.hidden = torch.nn.Sequential(*hidden, torch.nn.ReLU())
        self.delta = sequential([(weights[:3], biases[:3])])
        self.share = torch.nn.Sequential(*sequential([(weights[3:], biases[3:])]), torch.nn.ReLU())

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """What is left of each row's error acceleration."""
        h = self.hidden(features)
        faded: torch.Tensor = self.delta(h) * self.share(h)
        return faded


def network_module(layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> torch.nn.Module:
    """The folded `layers` of a network (N, F) -> (N, 3), with its fade where it has one."""
    return sequential(layers) if len(layers[-1][1]) == 3 else Fading(layers)


def sequential(layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> torch.nn.Sequential:
    """The `layers`, weights (K, F) and biases (K,), as torch trains and exports them, with rectified linear units
    between."""
    modules: list[torch.nn.Module] = []
    for weights, biases in layers:
        if modules:
            modules.append(torch.nn.ReLU())
        linear = torch.nn.Linear(weights.shape[1], weights.shape[0])
        with torch.no_grad():
            linear.weight.copy_(torch.tensor(weights))
            linear.bias.copy_(torch.tensor(biases))
        modules.append(linear)
    return torch.nn.Sequential(*modules)


def not_exported(model: Model) -> tuple[str, ...]:
    """Effects of the model that a vehicle cannot correct: errors of the sensor, and effects with memory but those that
    its controller undoes by looking ahead."""
    held = [e for e, _ in model.effect_chain() if not e.exports or e.stage is Stage.SENSOR]
    return tuple(e.name for e in held if not e.undone_by_look_ahead)


def export_onnx(
    model: Model, *flights: Flight, actuation: Mapping[str, float] | None = None, adaptive: bool = False
) -> bytes:
    """The model as an ONNX file, effects and network in one graph, with golden vectors taken from `flights`.

    The range in which the file may be believed is that of `flights`, together with a network's own; beside a network
    that does not fade by itself it is the network's alone. Golden vectors of one that does are in its range, half
    faded and far outside. `actuation` holds what is known of the path from command to motion, by the names of
    `models.contract.ACTUATION_LIMITS`. With `adaptive` numbers of it can be learnt anew in flight (`models.adaptive`).

    Raises `InputError` where a flight lacks position, velocity, attitude or command, and where there is nothing to
    learn.
    """
    learnables: tuple[Learnable, ...] = ()
    if adaptive:
        model, learnables = with_learnables(model)
    names = feature_names(model)
    table = np.concatenate(
        [
            feature_matrix(features_of_flight(f, f.flying if f.flying is not None else slice(None)), names)
            for f in flights
        ]
    )
    rows = table[np.linspace(0, len(table) - 1, GOLDEN).astype(int)]
    if model.network is not None and model.network.margin is not None:
        rows = np.concatenate([rows, _outside(model.network, names, rows[0])])
    module = Adaptive(model, names, learnables) if adaptive else Correction(model, names)
    module.eval()
    given = [torch.from_numpy(rows)]
    if adaptive:
        given.append(torch.from_numpy(_golden_parameters(learnables, len(rows))))
    with torch.no_grad():
        answered = module(*given)
    golden = (answered[0] if adaptive else answered).numpy()
    units = {**contract.FEATURES, **contract.YAW_FEATURES}
    low, high = _believed(model, names, table)
    data_hash = model.data_hash or "+".join(f.data_hash for f in flights)
    links: list[dict[str, object]] = [{"effect": e.name, "parameters": v} for e, v in module.chain]
    if (network := model.network) is not None:
        data_hash = network.data_hash
        links.append(
            {"effect": "network", "parameters": {"hash": network.hash, "layers": list(network.widths)}}
        )
    if len(data_hash) > contract.LONGEST_WORD:  # of many flights
        data_hash = hashlib.sha256(data_hash.encode()).hexdigest()
    metadata = {
        contract.KEY_CONTRACT: contract.CONTRACT_VERSION,
        contract.KEY_NAME: model.name or model.label,
        contract.KEY_VERSION: str(model.version),
        contract.KEY_VEHICLE: json.dumps(
            {
                "name": model.vehicle.name,
                "mass": model.vehicle.mass,
                "hover_thrust": model.vehicle.hover_thrust,
            }
        ),
        contract.KEY_FEATURES: json.dumps(
            [
                {
                    "name": n,
                    "unit": units[n],
                    "low": float(low[n]),
                    "high": float(high[n]),
                }
                for n in names
            ]
        ),
        contract.KEY_CHAIN: json.dumps(links),
        contract.KEY_DATA_HASH: data_hash,
        contract.KEY_GOLDEN_FEATURES: json.dumps(rows.tolist()),
        contract.KEY_GOLDEN_DELTA: json.dumps(golden.tolist()),
    }
    if actuation:
        metadata[contract.KEY_ACTUATION] = json.dumps(dict(actuation))
    if adaptive:
        metadata |= {
            contract.KEY_ADAPTIVE: json.dumps([one.table() for one in learnables]),
            contract.KEY_NOISE: json.dumps(_noise(model, flights)),
            contract.KEY_GOLDEN_PARAMETERS: json.dumps(given[1].tolist()),
            contract.KEY_GOLDEN_SENSITIVITY: json.dumps(answered[1].tolist()),
        }
    return _with_metadata(_graph(module, given), metadata)


def _believed(
    model: Model, names: tuple[str, ...], table: np.ndarray
) -> tuple[dict[str, float], dict[str, float]]:
    """The range of each feature in which a file may be believed: lowest and greatest by name, from the features
    `table` (N, F) of its flights and from its network."""
    low, high = (dict(zip(names, end, strict=True)) for end in (table.min(axis=0), table.max(axis=0)))
    if (network := model.network) is not None:
        fades = network.margin is not None
        for name, least, most in zip(network.features, network.low, network.high, strict=True):
            low[name] = min(low[name], least) if fades else least
            high[name] = max(high[name], most) if fades else most
    return low, high


def _outside(network: Network, names: tuple[str, ...], row: np.ndarray) -> np.ndarray:
    """Two rows of features (2, F) like `row` (F,), but with one feature half a margin and two margins beyond the
    network's range, and all others in it."""
    assert network.margin is not None
    rows = np.stack([row, row])
    for name, low, high in zip(network.features, network.low, network.high, strict=True):
        column = names.index(name)
        rows[:, column] = np.clip(rows[:, column], low, high)
    nearest = int(np.argmin(network.margin))
    away = network.high[nearest] + np.array([0.5, 2.0]) * network.margin[nearest]
    rows[:, names.index(network.features[nearest])] = away
    return rows


def _golden_parameters(learnables: Sequence[Learnable], count: int) -> np.ndarray:
    """Parameters (`count`, P) at which the golden vectors are evaluated: as deployed in every second row, anywhere in
    their range in the others."""
    value, low, high = (np.array([getattr(one, k) for one in learnables]) for k in ("value", "low", "high"))
    drawn = low + np.random.default_rng(0).uniform(size=(count, len(value))) * (high - low)
    drawn[::2] = value
    return drawn.astype(np.float32)


def _noise(model: Model, flights: Sequence[Flight]) -> list[float]:
    """RMS (m/s², three axes of the body) of what the model leaves of the accelerometer's reading, low-passed."""
    squares, count = np.zeros(3), 0
    for flight in flights:
        if flight.specific_force is None:
            continue
        predicted = specific_force(apply_effects(motion_of_flight(flight), model.chain()))
        rows = flight.flying if flight.flying is not None else slice(None)
        left = (flight.specific_force - predicted)[rows]
        left = np.stack([lagged(left[:, i], SMOOTHING, flight.dt) for i in range(3)], axis=1)
        left = left[np.all(np.isfinite(left), axis=1)]
        squares, count = squares + np.sum(left**2, axis=0), count + len(left)
    rms = np.sqrt(squares / count) if count else np.zeros(3)
    return [float(max(LEAST_NOISE, one)) for one in rms]


def _graph(module: torch.nn.Module, given: Sequence[torch.Tensor]) -> onnx.ModelProto:
    ports = [contract.INPUT_NAME, contract.PARAMETERS_NAME][: len(given)]
    outputs = [contract.OUTPUT_NAME, contract.SENSITIVITY_NAME][: len(given)]
    batch = torch.export.Dim("N", min=1)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        traced = torch.export.export(
            module,
            tuple(given),
            dynamic_shapes={name: {0: batch} for name in ports},
        )
        program = torch.onnx.export(
            simplify(traced),
            (),
            dynamo=True,
            verbose=False,
            input_names=ports,
            output_names=outputs,
        )
    assert program is not None
    return program.model_proto


def _with_metadata(graph: onnx.ModelProto, metadata: dict[str, str]) -> bytes:
    del graph.metadata_props[:]
    for node in graph.graph.node:  # torch leaves source paths of this machine there
        del node.metadata_props[:]
        node.doc_string = ""
    onnx.helper.set_model_props(graph, metadata)
    onnx.checker.check_model(graph)
    buffer = io.BytesIO()
    onnx.save(graph, buffer)
    return buffer.getvalue()
