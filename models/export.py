"""A model as one ONNX file with its contract in the metadata. Needs torch; on the ground only."""

from __future__ import annotations

import io
import json
import logging
import warnings

import numpy as np
import onnx
import torch

from models import contract
from models.features import feature_matrix, feature_names, features_of_flight
from models.flight import Flight
from models.model import Model
from models.prediction import error_acceleration, motion_of_features

GOLDEN = 8
"""Golden vectors in each file."""


class Correction(torch.nn.Module):
    """`delta` (N, 3) of features (N, F): the chain of effects minus the hover linearisation, heading frame, m/s²."""

    def __init__(self, model: Model, names: tuple[str, ...]) -> None:
        super().__init__()
        self.names, self.vehicle = names, model.vehicle
        self.chain = [
            (effect, {k: float(v) for k, v in values.items()})
            for effect, values in model.chain()
            if effect.exports and effect.name != "accelerometer_bias"
        ]

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Error acceleration of each row."""
        columns = {name: features[:, i] for i, name in enumerate(self.names)}
        return error_acceleration(motion_of_features(columns, self.vehicle), self.chain)


def not_exported(model: Model) -> tuple[str, ...]:
    """Effects of the model that a static correction cannot hold: those with memory, and errors of the sensor."""
    return tuple(e.name for e, _ in model.chain() if not e.exports or e.name == "accelerometer_bias")


def export_onnx(model: Model, flight: Flight) -> bytes:
    """The model as an ONNX file, its training range and golden vectors taken from `flight`.

    Raises `InputError` where the flight lacks position, velocity, attitude or command.
    """
    names = feature_names(model.names())
    columns = features_of_flight(flight, flight.flying if flight.flying is not None else slice(None))
    table = feature_matrix(columns, names)
    module = Correction(model, names).eval()
    rows = np.linspace(0, len(table) - 1, GOLDEN).astype(int)
    with torch.no_grad():
        golden = module(torch.from_numpy(table[rows])).numpy()
    units = {**contract.FEATURES, **contract.YAW_FEATURES}
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
                    "low": float(table[:, i].min()),
                    "high": float(table[:, i].max()),
                }
                for i, n in enumerate(names)
            ]
        ),
        contract.KEY_CHAIN: json.dumps([{"effect": e.name, "parameters": v} for e, v in module.chain]),
        contract.KEY_DATA_HASH: model.data_hash or flight.data_hash,
        contract.KEY_GOLDEN_FEATURES: json.dumps(table[rows].tolist()),
        contract.KEY_GOLDEN_DELTA: json.dumps(golden.tolist()),
    }
    return _with_metadata(_graph(module, table[: max(2, GOLDEN)]), metadata)


def _graph(module: torch.nn.Module, example: np.ndarray) -> onnx.ModelProto:
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            module,
            (torch.from_numpy(example),),
            dynamo=True,
            verbose=False,
            input_names=[contract.INPUT_NAME],
            output_names=[contract.OUTPUT_NAME],
            dynamic_shapes={"features": {0: torch.export.Dim("N", min=1)}},
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
