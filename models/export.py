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

from trueflight.models import contract
from trueflight.models.effect import Stage
from trueflight.models.export_graph import simplify
from trueflight.models.features import feature_matrix, feature_names, features_of_flight
from trueflight.models.flight import Flight
from trueflight.models.model import Model
from trueflight.models.network import folded_layers
from trueflight.models.prediction import error_acceleration, motion_of_features

GOLDEN = 8
"""Golden vectors in each file."""


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
            self.network = sequential(folded_layers(model.network, names))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Error acceleration of each row."""
        learnt = None if self.network is None else self.network(features)
        if not self.chain and learnt is not None:
            return learnt
        columns = {name: features[:, i] for i, name in enumerate(self.names)}
        known: Any = error_acceleration(motion_of_features(columns, self.vehicle), self.chain)
        return known if learnt is None else known + learnt


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


def export_onnx(model: Model, *flights: Flight, actuation: Mapping[str, float] | None = None) -> bytes:
    """The model as an ONNX file, effects and network in one graph, with golden vectors taken from `flights`.

    The training range is the network's own, and that of `flights` where there is no network. `actuation` holds
    what is known of the path from command to motion, by the names of `models.contract.ACTUATION_LIMITS`.

    Raises `InputError` where a flight lacks position, velocity, attitude or command.
    """
    names = feature_names(model)
    table = np.concatenate(
        [
            feature_matrix(features_of_flight(f, f.flying if f.flying is not None else slice(None)), names)
            for f in flights
        ]
    )
    module = Correction(model, names).eval()
    rows = np.linspace(0, len(table) - 1, GOLDEN).astype(int)
    with torch.no_grad():
        golden = module(torch.from_numpy(table[rows])).numpy()
    units = {**contract.FEATURES, **contract.YAW_FEATURES}
    low, high = (
        dict(zip(names, table.min(axis=0), strict=True)),
        dict(zip(names, table.max(axis=0), strict=True)),
    )
    data_hash = model.data_hash or "+".join(f.data_hash for f in flights)
    links: list[dict[str, object]] = [{"effect": e.name, "parameters": v} for e, v in module.chain]
    if (network := model.network) is not None:
        low.update(zip(network.features, network.low, strict=True))
        high.update(zip(network.features, network.high, strict=True))
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
        contract.KEY_GOLDEN_FEATURES: json.dumps(table[rows].tolist()),
        contract.KEY_GOLDEN_DELTA: json.dumps(golden.tolist()),
    }
    if actuation:
        metadata[contract.KEY_ACTUATION] = json.dumps(dict(actuation))
    return _with_metadata(_graph(module, table[: max(2, GOLDEN)]), metadata)


def _graph(module: torch.nn.Module, example: np.ndarray) -> onnx.ModelProto:
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        traced = torch.export.export(
            module,
            (torch.from_numpy(example),),
            dynamic_shapes={"features": {0: torch.export.Dim("N", min=1)}},
        )
        program = torch.onnx.export(
            simplify(traced),
            (),
            dynamo=True,
            verbose=False,
            input_names=[contract.INPUT_NAME],
            output_names=[contract.OUTPUT_NAME],
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
