"""Training the network of a model: recipes, one reproducible loop, checkpoints.

A recipe is the paper's, or the project's own: see docs/network.md for what each reaches on the same flights.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from trueflight.groundstation.learn.training_data import Samples, split
from trueflight.models.contract import FEATURES, YAW_FEATURES
from trueflight.models.errors import InputError
from trueflight.models.export import sequential
from trueflight.models.network import Network, error_acceleration_of
from trueflight.models.outside import unreadable
from trueflight.models.whole_file import write_whole

WIDTHS = (64, 64)
"""Hidden layers of the paper."""
CHECKPOINT_SECONDS = 5.0
MATERIAL_MEMORY = 0.1
"""Share of the remaining error from which a lag that the base model lacks is told of."""
_FLOORS = {"m": 0.1, "m/s": 0.2, "V": 0.2, "1": 0.01, "N": 0.1}
"""Least scale of an input, by unit, so that a small step outside the training range stays a small step."""


@dataclass(frozen=True)
class Recipe:
    """How a network is trained.

    `optimiser` is nadam or adamw, with learning rate `rate`, `betas` and `weight_decay`; `schedule` is plateau
    (`rate` times `factor` after `plateau` epochs without improvement) or one_cycle (warm-up over `warm_up` of all
    steps, then a cosine down to nothing). `average` is the time constant, in epochs, of the moving average of
    the weights that is validated and kept (0: none). Training ends after `epochs`, or `patience` epochs without a lower
    validation loss.
    """

    name: str
    optimiser: str
    rate: float
    batch: int
    epochs: int
    schedule: str
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 0.0
    factor: float = 2.0 / 3.0
    plateau: int = 10
    warm_up: float = 0.1
    average: float = 0.0
    patience: int = 100
    threads: int = 1


PAPER = Recipe("paper", "nadam", 0.05, 256, 1000, "plateau")
"""Carvalho et al. 2022, section V. Patience of the plateau, and of the end, are not in the paper: 10 is Keras's."""
OWN = Recipe("default", "adamw", 0.02, 1024, 60, "one_cycle", weight_decay=0.1, average=1.0, patience=30)
RANGE_TAIL = 0.001
"""Share of the samples at each end of a feature that does not count to the training range: a network has learnt
nothing where it has seen a handful of samples."""
FADE = 0.5
"""Share of the training range by which one feature may leave it until nothing of the network acts: chosen by
`benchmarks/network_fade.py`, see docs/network.md."""
FADE_LEAST = {"m": 0.2, "m/s": 0.5, "V": 0.5, "1": 0.1, "N": 1.0}
"""The least of it, by unit: noise and trim, where training hardly moved a feature."""
UNCOUNTED = 1e6
"""The margin of a cosine: how far the vehicle is tilted or turned, its sine tells."""
RECIPES = {"default": OWN, "paper": PAPER}


@dataclass(frozen=True)
class Epoch:
    """One line of the history: RMS per axis (3,), m/s², heading frame, and the learning rate."""

    train: tuple[float, float, float]
    validation: tuple[float, float, float]
    rate: float
    seconds: float

    @property
    def validation_rms(self) -> float:
        """RMS over the axes."""
        return math.sqrt(sum(v * v for v in self.validation) / 3.0)

    @property
    def train_rms(self) -> float:
        """RMS over the axes."""
        return math.sqrt(sum(v * v for v in self.train) / 3.0)


@dataclass(frozen=True)
class Training:
    """A finished training: the network, every epoch, and the samples by side."""

    network: Network
    history: tuple[Epoch, ...]
    best: int
    train: np.ndarray
    validation: np.ndarray
    interrupted: bool = False

    @property
    def seconds(self) -> float:
        """Time that training took, s."""
        return sum(e.seconds for e in self.history)


def recipe_named(name: str) -> Recipe:
    """A recipe by name; raises `InputError` for an unknown one."""
    if name not in RECIPES:
        raise InputError(f"unknown recipe '{name}'; known: {', '.join(RECIPES)}")
    return RECIPES[name]


def train(
    samples: Samples,
    recipe: Recipe = OWN,
    widths: Sequence[int] = WIDTHS,
    seed: int = 0,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Callable[[int, Epoch], None] = lambda _number, _epoch: None,
) -> Training:
    """Train a network on two thirds of `samples`, blockwise, and keep the weights that predict the rest best.

    The same samples, recipe, widths and seed give the same weights on the same machine. With a `checkpoint` file,
    Ctrl-C ends with what there is (`interrupted`), and `resume` goes on from there to the very same result. `progress`
    is called after each epoch with its number, from 1.

    Raises `InputError` for impossible widths or a checkpoint of another training.
    """
    if not widths or any(not 1 <= w <= 1024 for w in widths) or len(widths) > 7:
        raise InputError(f"--layers {','.join(map(str, widths))}: give one to seven widths of 1 to 1024 each")
    samples = samples.with_features(samples.varying)
    if not samples.names:
        raise InputError("nothing varies in these flights; fly more than a hover")
    sides = split(samples, seed)
    with _threads(recipe.threads):
        run = _Run(samples, sides, recipe, tuple(widths), seed)
        if resume and checkpoint is not None:
            run.restore(checkpoint)
        interrupted = False
        try:
            saved = time.monotonic()
            while not run.finished:
                progress(run.step_epoch(), run.history[-1])
                if checkpoint is not None and time.monotonic() - saved > CHECKPOINT_SECONDS:
                    run.save(checkpoint)
                    saved = time.monotonic()
        except KeyboardInterrupt:
            if checkpoint is None or not run.history:
                raise
            run.save(checkpoint)
            interrupted = True
        return run.result(interrupted)


class _Run:
    """One training on its way, epoch by epoch. All that a resumed run needs is in `state`."""

    def __init__(
        self,
        samples: Samples,
        sides: tuple[np.ndarray, np.ndarray],
        recipe: Recipe,
        widths: tuple[int, ...],
        seed: int,
    ) -> None:
        self.samples, self.sides, self.recipe, self.widths, self.seed = samples, sides, recipe, widths, seed
        x, y = samples.features[sides[0]], samples.target[sides[0]]
        units = {**FEATURES, **YAW_FEATURES}
        self.centre = x.mean(axis=0)
        self.scale = np.maximum(x.std(axis=0), [_FLOORS[units[n]] for n in samples.names]).astype(np.float32)
        self.out = np.maximum(y.std(axis=0), 1e-3).astype(np.float32)
        self.low, self.high = np.quantile(x, (RANGE_TAIL, 1.0 - RANGE_TAIL), axis=0).astype(np.float32)
        self.margin = _margin(samples.names, self.low, self.high)
        self.x, self.y = (self._normalised(samples.only(side)) for side in sides)
        # squared error in (m/s²)², whatever the scale of each output
        self.weight = torch.from_numpy(self.out**2)
        self.module = sequential(_initial(len(samples.names), widths, seed))
        self.parameters = list(self.module.parameters())
        self.average = [p.detach().clone() for p in self.parameters]
        self.optimiser = _optimiser(recipe, self.parameters)
        self.generator = torch.Generator().manual_seed(seed)
        self.steps = max(1, len(self.x[0]) // recipe.batch)
        self.history: list[Epoch] = []
        self.best, self.best_loss = 0, math.inf
        self.kept = [p.clone() for p in self.average]
        self.waited, self.rate = 0, recipe.rate
        self.last_state: dict[str, Any] = {}

    def _normalised(self, part: Samples) -> tuple[torch.Tensor, torch.Tensor]:
        return (
            torch.from_numpy((part.features - self.centre) / self.scale),
            torch.from_numpy(part.target / self.out),
        )

    @property
    def finished(self) -> bool:
        done = len(self.history)
        return done >= self.recipe.epochs or (done > 0 and done - self.best >= self.recipe.patience)

    def step_epoch(self) -> int:
        """Train for one epoch and validate; returns its number, from 1."""
        begin = time.perf_counter()
        recipe, (x, y) = self.recipe, self.x
        order = torch.randperm(len(x), generator=self.generator)
        keep = math.exp(-1.0 / (recipe.average * self.steps)) if recipe.average else 0.0
        squares = torch.zeros(3)
        batch = min(recipe.batch, len(x))
        done = len(self.history) * self.steps
        for step in range(self.steps):
            rows = order[step * batch : (step + 1) * batch]
            self._set_rate(done + step)
            error = self.module(x[rows]) - y[rows]
            squared = (error * error).mean(dim=0)
            loss = (squared * self.weight).sum()
            loss.backward()
            self.optimiser.step()
            self.optimiser.zero_grad()
            squares += squared.detach()
            if keep:
                # early on the average is short, so that it does not drag the first weights along
                share = min(keep, (done + step + 1) / (done + step + 10))
                torch._foreach_lerp_(self.average, [p.detach() for p in self.parameters], 1.0 - share)
        if not keep:
            self.average = [p.detach().clone() for p in self.parameters]
        validation = self._validate()
        train_rms = torch.sqrt(squares / self.steps).numpy() * self.out
        epoch = Epoch(_three(train_rms), _three(validation), self.rate, time.perf_counter() - begin)
        self.history.append(epoch)
        self._judge(epoch.validation_rms**2)
        self.last_state = self._state()
        return len(self.history)

    def _set_rate(self, step: int) -> None:
        if self.recipe.schedule == "one_cycle":
            total = self.steps * self.recipe.epochs
            warm = max(1.0, self.recipe.warm_up * total)
            rising = min(1.0, (step + 1) / warm)
            falling = 0.5 * (1.0 + math.cos(math.pi * max(0.0, step - warm) / max(1.0, total - warm)))
            self.rate = self.recipe.rate * rising * falling
        self.optimiser.param_groups[0]["lr"] = self.rate

    @torch.no_grad()
    def _validate(self) -> np.ndarray:
        x, y = self.y
        names = [name for name, _ in self.module.named_parameters()]
        weights = dict(zip(names, self.average, strict=True))
        error = torch.func.functional_call(self.module, weights, (x,)) - y
        return torch.sqrt((error * error).mean(dim=0)).numpy() * self.out

    def _judge(self, loss: float) -> None:
        """Keep the best weights, and lower the rate on a plateau."""
        if loss < self.best_loss * (1.0 - 1e-4):
            self.best_loss, self.best, self.waited = loss, len(self.history), 0
            self.kept = [p.clone() for p in self.average]
            return
        self.waited += 1
        if self.recipe.schedule == "plateau" and self.waited >= self.recipe.plateau:
            self.rate *= self.recipe.factor
            self.waited = 0

    # --- checkpoints ------------------------------------------------------------------------------------------------

    @property
    def key(self) -> str:
        """What a checkpoint belongs to."""
        recipe = asdict(self.recipe)
        what = [recipe, self.widths, self.seed, self.samples.names, self.samples.data_hash, len(self.samples)]
        digest = hashlib.sha256(json.dumps(what).encode())
        digest.update(self.samples.target.tobytes())
        return digest.hexdigest()[:16]

    def _state(self) -> dict[str, Any]:
        optimiser = self.optimiser.state_dict()
        return {
            "key": self.key_once,
            "parameters": [p.detach().clone() for p in self.parameters],
            "average": [p.clone() for p in self.average],
            "kept": [p.clone() for p in self.kept],
            "optimiser": {
                "state": {
                    k: {n: v.clone() if isinstance(v, torch.Tensor) else v for n, v in s.items()}
                    for k, s in optimiser["state"].items()
                },
                "param_groups": [dict(g) for g in optimiser["param_groups"]],
            },
            "generator": self.generator.get_state(),
            "history": [asdict(e) for e in self.history],
            "best": self.best,
            "best_loss": self.best_loss,
            "waited": self.waited,
            "rate": self.rate,
        }

    @property
    def key_once(self) -> str:
        if not hasattr(self, "_key"):
            self._key = self.key
        return self._key

    def save(self, path: Path) -> None:
        """Write the state after the last whole epoch, at once or not at all."""
        buffer = io.BytesIO()
        torch.save(self.last_state, buffer)
        write_whole(path, buffer.getvalue(), "the checkpoint", "pass --store DIR")

    def restore(self, path: Path) -> None:
        """Go on from a checkpoint."""
        try:
            state = torch.load(path, weights_only=True)
            same = state["key"] == self.key_once
        except OSError:
            raise InputError(f"{path}: no checkpoint to resume; train without --resume") from None
        except Exception as error:  # noqa: BLE001 - torch raises many kinds for a damaged file
            raise InputError(
                f"{path}: damaged checkpoint ({type(error).__name__}); train without --resume"
            ) from None
        if not same:
            raise InputError(
                f"{path}: of another training (flights, recipe, layers or seed); train without --resume"
            )
        with unreadable(path, "the checkpoint", "train without --resume"), torch.no_grad():
            for mine, saved in zip(self.parameters, state["parameters"], strict=True):
                mine.copy_(saved)
            self.average, self.kept = state["average"], state["kept"]
            self.optimiser.load_state_dict(state["optimiser"])
            self.generator.set_state(state["generator"])
            self.history = [Epoch(**e) for e in state["history"]]
            self.best, self.best_loss = state["best"], state["best_loss"]
            self.waited, self.rate = state["waited"], state["rate"]
            self.last_state = state

    # --- the result -------------------------------------------------------------------------------------------------

    def result(self, interrupted: bool) -> Training:
        """The best weights as a network."""
        arrays = [p.detach().numpy().astype(np.float32) for p in self.kept]
        layers = tuple(zip(arrays[::2], arrays[1::2], strict=True))
        best = self.history[self.best - 1]
        fit = {
            "train_rms": best.train_rms,
            "validation_rms": best.validation_rms,
            "noise_floor": self.samples.noise_floor,
            **{f"validation_rms_{a}": v for a, v in zip("xyz", best.validation, strict=True)},
            **{f"noise_floor_{a}": float(v) for a, v in zip("xyz", self.samples.noise, strict=True)},
            "before_rms": float(np.sqrt(np.mean(self.samples.target[self.sides[1]] ** 2))),
            "epochs": float(len(self.history)),
            "seconds": sum(e.seconds for e in self.history),
            "flight_seconds": self.samples.seconds,
        }
        network = Network(
            features=self.samples.names,
            centre=self.centre,
            scale=self.scale,
            layers=layers,
            output_scale=self.out,
            low=self.low,
            high=self.high,
            data_hash=self.samples.data_hash,
            seed=self.seed,
            recipe=self.recipe.name,
            fit=fit,
            margin=self.margin,
        )
        return Training(network, tuple(self.history), self.best, *self.sides, interrupted=interrupted)


def _margin(names: Sequence[str], low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """How far beyond `low` to `high` (F,) each feature alone takes the network to nothing, in its unit."""
    units = {**FEATURES, **YAW_FEATURES}
    least = [UNCOUNTED if name.startswith("cos_") else FADE_LEAST[units[name]] for name in names]
    return np.maximum(FADE * (high - low), least).astype(np.float32)


def _initial(inputs: int, widths: Sequence[int], seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights that keep the variance through rectified linear units (He et al. 2015); biases spread the kinks."""
    generator = np.random.default_rng([seed, inputs, *widths])
    sizes, layers = [inputs, *widths, 3], []
    for number, (a, b) in enumerate(pairwise(sizes)):
        last = number == len(sizes) - 2
        gain = 0.1 if last else math.sqrt(2.0)
        weights = generator.normal(0.0, gain / math.sqrt(a), (b, a))
        biases = np.zeros(b) if last else generator.uniform(-0.5, 0.5, b)
        layers.append((weights.astype(np.float32), biases.astype(np.float32)))
    return layers


def _optimiser(recipe: Recipe, parameters: list[torch.nn.Parameter]) -> torch.optim.Optimizer:
    if recipe.optimiser == "nadam":
        return torch.optim.NAdam(
            parameters,
            recipe.rate,
            recipe.betas,
            weight_decay=recipe.weight_decay,
            decoupled_weight_decay=True,
        )
    return torch.optim.AdamW(
        parameters, recipe.rate, recipe.betas, weight_decay=recipe.weight_decay, fused=True
    )


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Torch on so many threads: more do not help such small products, and the sum's order stays the same."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _three(values: np.ndarray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def memory_share(samples: Samples, training: Training) -> float:
    """Part of the held-out squared error in z, 0 to 1, that goes with the rate of change of thrust.

    A static map cannot follow a lag or a delay: to first order what it misses is proportional to that rate.
    """
    held = samples.only(training.validation)
    features = held.with_features(training.network.features).features
    whole = replace(training.network, margin=None)  # where it fades it leaves over more than a lag
    left = (held.target - error_acceleration_of(whole, features))[:, 2].astype(float)
    thrust = held.features[:, held.names.index("T")].astype(float)
    following = (np.diff(held.t, prepend=-1.0) < 1.5 * held.period) & (np.diff(held.flight, prepend=-1) == 0)
    rate = np.where(following, np.diff(thrust, prepend=thrust[0]) / held.period, 0.0)
    power = float(rate @ rate * (left @ left))
    return float(rate @ left) ** 2 / power if power > 0.0 else 0.0


def with_epochs(recipe: Recipe, epochs: int | None) -> Recipe:
    """The recipe with another number of epochs."""
    return recipe if epochs is None else replace(recipe, epochs=epochs)
