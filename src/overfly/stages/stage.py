"""What the training stages share: weighted losses, seeded randomness, learning rate, logging and the warm start."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar

import lightning as L
import numpy as np
import torch
from torch import Tensor, nn

from overfly.errors import InputError, unknown
from overfly.networks.blocks import Part

log = logging.getLogger("overfly")

Batch = dict[str, Tensor]
OptimizerFactory = Callable[..., torch.optim.Optimizer]

TERMS = (
    "chamfer", "emd", "adversarial", "adversarial_eq1", "correspondence", "matching", "retrieval", "correction",
    "height", "hypotheses", "sigma", "confidence",
)  # fmt: skip
"""The weights of conf/loss; each is named like its function in :mod:`overfly.losses`.

``matching`` is ``correspondence`` of the match map, where a sweep compares another map.
"""

TEST_SPLITS = ("test", "unseen")
"""Scenes of the styles that were trained on, and of other styles."""

PARTS = ("encoder", "generator", "discriminator")


def step_random(seed: int, epoch: int, batch_idx: int, rank: int) -> torch.Generator:
    """The generator of everything that is drawn in one step of one process."""
    state = np.random.SeedSequence((seed, epoch, batch_idx, rank)).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))


class Stage(L.LightningModule):
    """One phase of the training. All stages optimise by hand, so that one and two optimisers look alike.

    Args:
        network: with the parts ``encoder``, ``generator`` and ``discriminator``.
        loss: weight of each loss term; a stage takes those in its ``terms`` and leaves the others to other stages.
        optimizer: makes an optimiser from parameters (``_partial_: true`` in the YAML).
        epochs: over which the learning rate falls to 0 along a cosine.
        clip_norm: largest norm of the gradient.
        seed: of everything that is drawn in a step, with the epoch and the batch's index.
    """

    terms: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        *,
        network: nn.Module,
        loss: Mapping[str, float],
        optimizer: OptimizerFactory,
        epochs: int,
        clip_norm: float,
        seed: int,
    ) -> None:
        super().__init__()
        for name in loss:
            if name not in TERMS and name not in self.terms:  # a stage of one's own may have terms of its own
                raise unknown("The loss term", name, (*TERMS, *(term for term in self.terms if term not in TERMS)))
        self.weights = {name: float(loss[name]) for name in self.terms if loss.get(name)}
        if not self.weights:
            raise InputError(
                f"{type(self).__name__} has nothing to minimise: of {', '.join(self.terms)} at least one needs a "
                "weight above 0 in the loss, for instance loss=paper."
            )
        self.automatic_optimization = False
        self.network = network
        self.optimizer_factory = optimizer
        self.epochs, self.clip_norm, self.seed = epochs, clip_norm, seed

    def part(self, name: str) -> Part:
        """The network's encoder, generator or discriminator."""
        part = getattr(self.network, name)
        assert isinstance(part, Part)
        return part

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """The network's answer; ``points`` [B, N, 3] in window units among it."""
        output: dict[str, Tensor] = self.network(batch)
        return output

    def total(self, terms: Mapping[str, Tensor]) -> Tensor:
        """The weighted sum of the terms, each reduced to its mean."""
        return torch.stack([self.weights[name] * value.mean() for name, value in terms.items()]).sum()

    def random(self, batch_idx: int, *, epoch: int | None = None) -> torch.Generator:
        """The generator of everything that is drawn in one step."""
        epoch = self.current_epoch if epoch is None else epoch
        return step_random(self.seed, epoch, batch_idx, self.global_rank)

    def optimise(
        self, optimizer: Any, loss: Tensor, batch_idx: int, parts: Iterable[str], retain_graph: bool = False
    ) -> None:
        """One step of an optimiser that came from ``self.optimizers()`` (others save no checkpoint)."""
        batches = float(self.trainer.num_training_batches)
        done = self.current_epoch + (batch_idx / batches if math.isfinite(batches) and batches else 0)
        factor = (1 + math.cos(math.pi * min(done / self.epochs, 1))) / 2
        for group in optimizer.param_groups:
            group["lr"] = optimizer.defaults["lr"] * max(factor, 1e-3)
        optimizer.zero_grad()
        self.manual_backward(loss, retain_graph=retain_graph)
        self.clip_gradients(optimizer, gradient_clip_val=self.clip_norm, gradient_clip_algorithm="norm")
        optimizer.step()
        for name in parts:
            self.part(name).steps += 1

    def on_validation_start(self) -> None:
        """Batch statistics become the mean of all processes': so they all measure the same network, and save it."""
        if self.trainer.world_size > 1:
            for buffer in self.network.buffers():
                if buffer.is_floating_point():
                    buffer.copy_(self.trainer.strategy.reduce(buffer.clone(), reduce_op="mean"))

    def report(self, split: str, values: Mapping[str, Tensor | float], count: int) -> None:
        """Log values as ``<split>/<name>``: their mean over the epoch and all processes, each batch weighing ``count``.

        What one process cannot measure weighs nothing but is logged all the same: all wait for the same names.
        """
        if count or self.trainer.world_size > 1:
            named = {f"{split}/{name}": value for name, value in values.items()}
            self.log_dict(
                named, on_step=False, on_epoch=True, batch_size=count, sync_dist=True, add_dataloader_idx=False
            )

    def test_split(self, dataloader_idx: int) -> str:
        """The name of a test split, by which its metrics are logged: ``test``, then ``unseen``."""
        datamodule = getattr(self.trainer, "datamodule", None)
        names: list[str] = getattr(datamodule, "test_splits", list(TEST_SPLITS))
        return names[dataloader_idx]

    def warm_start(self, state: Mapping[str, Tensor], source: str) -> list[str]:
        """Start from the weights of another run.

        Every part that was trained there is taken over, strictly; parts that were not keep their fresh weights.

        Args:
            state: state dict of a checkpoint of any stage.
            source: where it came from, for the lines.

        Returns:
            One line for each part.

        Raises:
            InputError: the run trained no part, or its network is not the same.
        """
        parts, missing, unexpected, reshaped = {}, [], [], []
        for name in PARTS:
            prefix, own = f"network.{name}.", self.part(name).state_dict()
            given = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
            parts[name] = given
            missing += [prefix + key for key in own if key not in given]
            unexpected += [prefix + key for key in given if key not in own]
            reshaped += [prefix + key for key in own if key in given and given[key].shape != own[key].shape]
        problems = {"it lacks": missing, "it has besides": unexpected, "of another shape are": reshaped}
        if any(problems.values()):
            said = "; ".join(f"{what} {_some(keys)}" for what, keys in problems.items() if keys)
            raise InputError(f"The weights in {source} are of another network ({said}): take the same model and sizes.")
        trained = {name: int(given["steps"]) for name, given in parts.items()}
        if not any(trained.values()):
            raise InputError(f"The run {source} has trained nothing yet: let it train, or leave from_run out.")
        lines = []
        for name, steps in trained.items():
            if steps:
                self.part(name).load_state_dict(parts[name])
                lines.append(f"{name}: from {source} ({steps} training steps)")
            else:
                lines.append(f"{name}: untrained in {source}, starts at random (seeded)")
        return lines


def _some(keys: list[str], most: int = 3) -> str:
    return ", ".join(keys[:most]) + (f" and {len(keys) - most} more" if len(keys) > most else "")
