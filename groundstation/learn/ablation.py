"""What a network needs: depth, width and features, each against its error, its size and its time on the vehicle."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import onnxruntime

from trueflight.groundstation.learn.training import Recipe, train
from trueflight.groundstation.learn.training_data import Samples
from trueflight.models import contract
from trueflight.models.export import export_onnx
from trueflight.models.flight import Flight
from trueflight.models.model import Model
from trueflight.models.network import Network, error_acceleration_of

DEPTHS = (1, 2, 3)
WIDTHS = (8, 16, 32, 64, 128)
NEAR = 1.05
"""A network is as good as the best up to this ratio of validation RMS."""
TIMING_RUNS, TIMING_BATCHES = 500, 8
SHUFFLES = 5
LEAST_IMPORTANT = 3
"""Features that are tried to do without."""


@dataclass(frozen=True)
class Architecture:
    """One network of the ablation: RMS in m/s², heading frame, mean over axes; `inference` in s, median, one thread."""

    widths: tuple[int, ...]
    parameters: int
    train_rms: float
    validation_rms: float
    onnx_bytes: int
    inference: float
    seconds: float
    best: bool = False
    smallest: bool = False

    @property
    def label(self) -> str:
        """Its hidden layers."""
        return "-".join(map(str, self.widths))


@dataclass(frozen=True)
class FeatureImportance:
    """Validation RMS (m/s²) with a feature shuffled among the samples, and of a network trained without it."""

    feature: str
    shuffled_rms: float
    without_rms: float | None = None


@dataclass(frozen=True)
class Ablation:
    """Networks in order of size, features in order of importance, and what to compare them with."""

    networks: tuple[Architecture, ...]
    features: tuple[FeatureImportance, ...]
    reference: str
    reference_rms: float
    before_rms: float
    noise_floor: float


def architectures(depths: Sequence[int] = DEPTHS, widths: Sequence[int] = WIDTHS) -> list[tuple[int, ...]]:
    """Hidden layers of every network of an ablation."""
    return [(width,) * depth for depth in depths for width in widths]


def ablate(
    samples: Samples,
    base: Model,
    flight: Flight,
    recipe: Recipe,
    seed: int,
    tried: Iterable[tuple[int, ...]],
    features: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> Ablation:
    """Train every network of `tried` on the same split, export it beside the effects of `base`, and time it.

    `features` also asks what each feature is worth to the best network. `flight` gives golden vectors to the export.
    `progress` is told what was done.
    """
    rows: list[Architecture] = []
    best: tuple[float, Network, np.ndarray] | None = None
    before = 0.0
    for widths in tried:
        done = train(samples, recipe, widths, seed)
        network = done.network
        exported = export_onnx(base.with_network(network), flight)
        rms, before = network.fit["validation_rms"], network.fit["before_rms"]
        rows.append(
            Architecture(
                widths, network.parameters, network.fit["train_rms"], rms, len(exported),
                inference_time(exported), done.seconds,
            )
        )  # fmt: skip
        if best is None or rms < best[0]:
            best = rms, network, done.validation
        progress(rows[-1].label)
    assert best is not None
    important: tuple[FeatureImportance, ...] = ()
    if features:
        important = feature_importance(samples, best[1], best[2], recipe, seed, progress)
    return Ablation(tuple(_marked(rows)), important, best[1].label, best[0], before, samples.noise_floor)


def _marked(rows: Sequence[Architecture]) -> list[Architecture]:
    """The rows by size, the best and the smallest as good as it marked."""
    ordered = sorted(rows, key=lambda r: r.parameters)
    least = min(r.validation_rms for r in ordered)
    smallest = next(r for r in ordered if r.validation_rms <= NEAR * least)
    return [replace(r, best=r.validation_rms == least, smallest=r is smallest) for r in ordered]


def inference_time(onnx: bytes) -> float:
    """Time in s of one inference of an exported model: ONNX Runtime, one thread, bound buffers.

    The least median of several batches: other work on the machine only ever adds to it.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(onnx, options, providers=["CPUExecutionProvider"])
    width = session.get_inputs()[0].shape[1]
    features, delta = np.zeros((1, width), np.float32), np.zeros((1, 3), np.float32)
    binding = session.io_binding()
    binding.bind_input(contract.INPUT_NAME, "cpu", 0, np.float32, features.shape, features.ctypes.data)
    binding.bind_output(contract.OUTPUT_NAME, "cpu", 0, np.float32, delta.shape, delta.ctypes.data)
    seconds = np.empty((TIMING_BATCHES, TIMING_RUNS))
    for batch in seconds:
        for run in range(TIMING_RUNS):
            begin = time.perf_counter()
            session.run_with_iobinding(binding)
            batch[run] = time.perf_counter() - begin
    return float(np.median(seconds, axis=1).min())


def feature_importance(
    samples: Samples,
    network: Network,
    validation: np.ndarray,
    recipe: Recipe,
    seed: int,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[FeatureImportance, ...]:
    """What each feature is worth to `network` on the held-out samples, the most important first.

    Each is shuffled among them; then the least important are left out, one at a time, of a new training: a network may
    lean on a feature that another one replaces.
    """
    held = samples.only(validation).with_features(network.features)
    generator = np.random.default_rng(seed)
    rows = []
    for column, name in enumerate(network.features):
        square = 0.0
        for _ in range(SHUFFLES):
            shuffled = held.features.copy()
            shuffled[:, column] = generator.permutation(shuffled[:, column])
            square += float(np.mean((error_acceleration_of(network, shuffled) - held.target) ** 2))
        rows.append(FeatureImportance(name, (square / SHUFFLES) ** 0.5))
        progress(f"{name} shuffled")
    rows.sort(key=lambda r: -r.shuffled_rms)
    kept = rows[:-LEAST_IMPORTANT]
    for row in rows[-LEAST_IMPORTANT:]:
        rest = [n for n in network.features if n != row.feature]
        if rest:
            again = train(samples.with_features(rest), recipe, network.widths, seed).network
            row = FeatureImportance(row.feature, row.shuffled_rms, again.fit["validation_rms"])
        kept.append(row)
        progress(f"without {row.feature}")
    return tuple(kept)
