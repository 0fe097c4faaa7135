"""Phase two: generator and discriminator, alternately, on a trained encoder."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from overfly import losses
from overfly.networks.discriminator import patches
from overfly.stages import surfaces
from overfly.stages.clouds import window_emd, window_metrics
from overfly.stages.stage import Batch, OptimizerFactory, Stage, log
from overfly.stages.surfaces import surface_metrics, surface_terms


class GanStage(Stage):
    """Alternating optimisation of ``network.generator`` and ``network.discriminator`` (section 3.3, Eq. 1).

    Each batch is one step of the discriminator on the clouds as they are, then one of the generator. *Accuracy* is the
    share of clouds, real and generated, that the discriminator calls right, and *loss* is its cross-entropy, as in the
    paper's Figure 3c and d; ``loss_generator`` is what the generator minimises (and the loss without a discriminator).

    Args:
        discriminator_optimizer: as ``optimizer``, for the second player.
        freeze_encoder: keep the encoder's weights and batch statistics; an encoder that was never trained is always
            trained along (a frozen random one would hide the images from the generator), and a line says so.
        discriminator_noise: standard deviation, in window units, of the noise on x and y of every cloud that the
            discriminator sees. Generated clouds stand in a grid of spacing 2 / 32, real ones do not: without noise it
            would look at nothing else and push the points off the grid instead of onto the surface.
        discriminator_patches: local patches of a cloud that the discriminator judges one by one; 1: the whole cloud.
        emd_points: size of the random subsets on which the ``emd`` term is computed (0.08 s a window at 1024).
        emd_batches: validation and test batches on which the exact EMD is measured.
        others: see :class:`overfly.stages.stage.Stage`.
    """

    terms: ClassVar[tuple[str, ...]] = ("chamfer", "emd", "adversarial", "adversarial_eq1", *surfaces.TERMS)
    accuracy: ClassVar[str] = "discriminator_accuracy"
    loss: ClassVar[str] = "loss_discriminator"

    def __init__(
        self,
        *,
        discriminator_optimizer: OptimizerFactory,
        freeze_encoder: bool,
        discriminator_noise: float,
        discriminator_patches: int,
        emd_points: int,
        emd_batches: int,
        **others: Any,
    ) -> None:
        super().__init__(**others)
        self.discriminator_optimizer_factory = discriminator_optimizer
        self.freeze_encoder, self.emd_points, self.emd_batches = freeze_encoder, emd_points, emd_batches
        self.discriminator_noise, self.discriminator_patches = discriminator_noise, discriminator_patches
        self.frozen: bool | None = None  # decided when the training begins, kept in checkpoints

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        # A frozen encoder is in the list too: then a checkpoint fits whether it was frozen or not.
        generator = [*self.part("encoder").parameters(), *self.part("generator").parameters()]
        return [
            self.optimizer_factory(generator),
            self.discriminator_optimizer_factory(self.part("discriminator").parameters()),
        ]

    def warm_start(self, state: Mapping[str, Tensor], source: str) -> list[str]:
        lines = super().warm_start(state, source)
        if not int(self.part("generator").steps):
            lines = [line for line in lines if not line.startswith("generator")]
            lines.append(self._blocks_from_encoder())
        return lines

    def setup(self, stage: str) -> None:
        if stage == "fit" and not int(self.part("generator").steps):
            line = self._blocks_from_encoder()
            if not int(self.part("encoder").steps):
                own = hasattr(self.network.generator, "start_from")
                log.info("%s%s", line, ", which itself starts at random (seeded)" if own else "")

    def on_fit_start(self) -> None:
        if self.frozen is None:
            self.frozen = self.freeze_encoder and int(self.part("encoder").steps) > 0
            if self.freeze_encoder and not self.frozen:
                log.info("encoder: not trained yet, so it is trained along with the generator instead of being frozen")
        self.part("encoder").requires_grad_(not self.frozen)

    def on_train_epoch_start(self) -> None:
        if self.frozen:
            self.part("encoder").eval()  # its batch statistics stay, too

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["encoder_frozen"] = bool(self.frozen)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.frozen = bool(checkpoint["encoder_frozen"])

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        output = self.network(batch)
        cloud, real = output["points"], batch["reference"]
        players = self.optimizers()
        assert isinstance(players, list)
        random, judged = self.random(batch_idx), None
        if self._adversarial():
            judged = self._discriminator_step(players[1], cloud.detach(), real, batch_idx, random)
        with self.toggled_optimizer(players[0]):
            terms = {**self._cloud_terms(cloud, real, random), **self.more_terms(output, batch, random)}
            loss = self.total(terms)
            parts = ["generator"] if self.frozen else ["encoder", "generator"]
            self.optimise(players[0], loss, batch_idx, parts)
        self._report_losses("train", loss, terms, len(real))
        self._report_clouds("train", cloud, batch)
        self._report_surfaces("train", output, batch)
        if judged is not None:
            self._report_players("train", *judged)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        self._evaluate(batch, batch_idx, "val")

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        self._evaluate(batch, batch_idx, self.test_split(dataloader_idx))

    def _discriminator_step(
        self, optimizer: Any, cloud: Tensor, real: Tensor, batch_idx: int, random: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        with self.toggled_optimizer(optimizer):
            on_real, on_cloud = self._logits(real, random), self._logits(cloud, random)
            self.optimise(optimizer, losses.discriminator(on_real, on_cloud).mean(), batch_idx, ["discriminator"])
        return on_real.detach(), on_cloud.detach()

    def _cloud_terms(self, cloud: Tensor, real: Tensor, random: torch.Generator) -> dict[str, Tensor]:
        terms = {}
        if "chamfer" in self.weights:
            terms["chamfer"] = losses.chamfer(cloud, real)
        if "emd" in self.weights:
            a, b = (torch.randperm(x.shape[1], generator=random)[: self.emd_points] for x in (cloud, real))
            terms["emd"] = losses.emd(cloud[:, a.to(cloud.device)], real[:, b.to(real.device)])
        if self._adversarial():
            logits = self._logits(cloud, random)
            for name in ("adversarial", "adversarial_eq1"):
                if name in self.weights:
                    terms[name] = getattr(losses, name)(logits)
        return terms

    def more_terms(self, output: dict[str, Any], batch: Batch, random: torch.Generator) -> dict[str, Tensor]:
        if "surfaces" not in output:
            return {}
        return surface_terms(output["surfaces"], batch, self.weights)

    def _evaluate(self, batch: Batch, batch_idx: int, split: str) -> None:
        output = self.network(batch)
        cloud, real = output["points"], batch["reference"]
        random = self.random(batch_idx, epoch=0)
        terms = {**self._cloud_terms(cloud, real, random), **self.more_terms(output, batch, random)}
        self._report_losses(split, self.total(terms), terms, len(real))
        self._report_clouds(split, cloud, batch)
        self._report_surfaces(split, output, batch)
        if self._adversarial():
            self._report_players(split, self._logits(real, random), self._logits(cloud, random))
        if batch_idx < self.emd_batches and cloud.shape[1] == real.shape[1]:
            pairs = zip(cloud.cpu().numpy(), real.cpu().numpy(), strict=True)
            values = [window_emd(a, b) for a, b in pairs]
            self.report(split, {"emd_sum_1024": sum(values) / len(values)}, len(values))

    def _adversarial(self) -> bool:
        return "adversarial" in self.weights or "adversarial_eq1" in self.weights

    def _logits(self, points: Tensor, random: torch.Generator) -> Tensor:
        noise = torch.randn(points.shape, generator=random).to(points) * self.discriminator_noise
        noise[..., 2] = 0
        judged = patches(points + noise, self.discriminator_patches)
        logits: Tensor = self.network.discriminator.logits(judged)  # type: ignore[union-attr, operator]
        return logits

    def _blocks_from_encoder(self) -> str:
        if not hasattr(self.network.generator, "start_from"):
            return "generator: starts at random (seeded)"
        line: str = self.network.generator.start_from(self.network.encoder)  # type: ignore[operator]
        return line

    def _report_losses(self, split: str, loss: Tensor, terms: dict[str, Tensor], count: int) -> None:
        named = {f"loss_{name}": value.detach().mean() for name, value in terms.items()}
        self._report(split, {"loss_generator": loss.detach(), **named}, count)

    def _report_clouds(self, split: str, cloud: Tensor, batch: Batch) -> None:
        arrays = (x.detach().cpu().numpy() for x in (cloud, batch["reference"], batch["scale"]))
        rows = [window_metrics(*window) for window in zip(*arrays, strict=True)]
        self._report(split, {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}, len(rows))

    def _report_surfaces(self, split: str, output: dict[str, Any], batch: Batch) -> None:
        if "surfaces" in output:
            values, count = surface_metrics(output, batch)
            for name in surfaces.METRICS:  # also those that this batch has nothing for
                self._report(split, {name: values.get(name, 0.0)}, count if name in values else 0)

    def _report_players(self, split: str, on_real: Tensor, on_cloud: Tensor) -> None:
        right = ((on_real > 0).float().mean() + (on_cloud < 0).float().mean()) / 2
        loss = losses.discriminator(on_real, on_cloud).mean()
        self._report(split, {"loss_discriminator": loss, "discriminator_accuracy": right}, len(on_real))

    def _report(self, split: str, values: dict[str, Any], count: int) -> None:
        """Log values, and again as ``loss`` and ``accuracy`` those that are this stage's."""
        names = {"accuracy": self.accuracy, "loss": self.loss if self._adversarial() else "loss_generator"}
        again = {name: values[source] for name, source in names.items() if source in values}
        self.report(split, {**values, **again}, count)
