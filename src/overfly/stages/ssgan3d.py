"""SS-GAN-3D: a rough mesh is refined by rendering it where the photographs were taken (second paper, section 3)."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, cast

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from overfly import image_losses
from overfly.errors import InputError, unknown
from overfly.rendering.render import Rendered
from overfly.rendering.reproject import reproject
from overfly.stages.exposures import Exposures
from overfly.stages.levels import PATIENCE, Levels, converged
from overfly.stages.refined_mesh import Mesh, Prepared, RefinedMesh, prepared
from overfly.stages.shots import COVERED, Shot, patches, shot_of
from overfly.stages.stage import Batch, OptimizerFactory, step_random

log = logging.getLogger("overfly")

SIMILARITY = ("alpha", "beta", "gamma", "centre", "slope")
"""Weights and constants of Eqs. 5 and 6."""

WEIGHTS = (*SIMILARITY, "adversarial", "theta", "consistency", "laplacian", "normal_consistency", "edge_length")


class Photographs(Protocol):
    """Those of one flight, and which of them are only measured on."""

    held_out: NDArray[np.bool_]


class Shots(Protocol):
    """What the stage asks of its data module, after ``setup``."""

    mesh: Mesh
    gsd: float
    photographs: Photographs


class SsGan3dStage(L.LightningModule):
    """Refines the mesh of one flight: observe, critic steps, one generator step, from coarse to fine.

    A step renders a few views (section 3.2), trains the critic on patches of photographs and renderings at the same
    places (Eqs. 7 and 8), and moves the mesh down Eq. 1: the reconstruction loss of Eq. 6 and ``adversarial`` (the
    paper's lambda) times the critic's verdict. Beyond the paper, ``consistency`` compares each photograph with its
    neighbour carried over by the mesh (:func:`overfly.rendering.reproject.reproject`), and three terms keep the mesh
    smooth.

    The epochs are shared equally among the levels. Each level starts by halving edges where the images differ most,
    until the mesh has the level's ``faces``, and compares images reduced ``shrink`` times. In the last level training
    stops as soon as the overall loss is below ``threshold`` and fell by less than ``tolerance`` of itself in the last
    epochs.

    Args:
        generator: makes the generator from vertices, colours and ``step`` (``_partial_: true`` in the YAML).
        critic: scores patches.
        loss: weights by name, of :data:`WEIGHTS`; ``centre`` and ``slope`` are those of Eq. 5.
        optimizer, critic_optimizer: make optimisers from parameters.
        epochs: in all levels together.
        levels: for each its ``faces`` and ``shrink``.
        step_gsd: metres per unit of the generator's offsets, in ground sampling distances.
        patches: patches of each photograph that the critic judges in a step.
        patch_size: pixels; smaller where the images are.
        critic_steps: steps of the critic before each of the generator, at least 1.
        robust: robust standard deviations above which a pixel counts as moved or foreign, from the second level on;
            None: never.
        exposure: whether each photograph's exposure is estimated.
        threshold: overall loss under which training may stop; None: whatever the loss.
        tolerance: share of the loss; 0: never stop early.
        seed: of everything that is drawn.

    Raises:
        InputError: a weight is unknown, nothing would be compared, or there is no level.
    """

    delivers_last = True
    """Its result is the mesh of the last epoch, not of the best one."""

    def __init__(
        self,
        *,
        generator: Callable[..., nn.Module],
        critic: nn.Module,
        loss: Mapping[str, float],
        optimizer: OptimizerFactory,
        critic_optimizer: OptimizerFactory,
        epochs: int,
        levels: Sequence[Mapping[str, int]],
        step_gsd: float,
        patches: int,
        patch_size: int,
        critic_steps: int,
        robust: float | None,
        exposure: bool,
        threshold: float | None,
        tolerance: float,
        seed: int,
    ) -> None:
        super().__init__()
        for name in loss:
            if name not in WEIGHTS:
                raise unknown("The weight", name, WEIGHTS)
        self.weights = {name: float(loss.get(name) or 0.0) for name in WEIGHTS}
        if not any(self.weights[name] for name in ("alpha", "beta", "gamma", "consistency", "adversarial")):
            raise InputError("Nothing compares the mesh with the photographs: give alpha, beta or gamma a weight.")
        self.automatic_optimization = False
        self.make_generator, self.critic = generator, critic
        self.optimizer_factory, self.critic_optimizer_factory = optimizer, critic_optimizer
        self.levels = Levels(epochs, levels)
        self.step_gsd, self.patches, self.patch_size, self.critic_steps = step_gsd, patches, patch_size, critic_steps
        self.robust, self.exposure, self.threshold, self.tolerance = robust, exposure, threshold, tolerance
        self.seed, self.level = seed, 0
        self.mesh: RefinedMesh
        self.exposures: Exposures
        self.gsd = math.nan
        self.overall: dict[int, float] = {}  # mean overall loss by epoch, of this level
        self.stopped_by = "the number of epochs"

    def configure_model(self) -> None:
        """Start from the data module's mesh."""
        if self.trainer.world_size > 1:
            raise InputError("A refinement is of one mesh and runs in one process: leave trainer=ddp out.")
        if not hasattr(self, "mesh"):
            data = cast(Shots, self.trainer.datamodule)  # type: ignore[attr-defined]
            self.gsd = float(data.gsd)
            self.exposures = Exposures(data.photographs.held_out).to(self.device)
            start, step = prepared(data.mesh, "cpu"), self.step_gsd * self.gsd
            self.mesh = RefinedMesh(start, generator=self.make_generator, step=step).to(self.device)

    def warm_start(self, state: Mapping[str, Tensor], source: str) -> list[str]:
        raise InputError(
            f"A refinement starts from a mesh, not from the weights in {source}: give its refined.ply as data.mesh=..."
        )

    # -- resuming ------------------------------------------------------------------------------------------------

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["refinement"] = {"level": self.level, "overall": self.overall}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.level, self.overall = checkpoint["refinement"]["level"], dict(checkpoint["refinement"]["overall"])

    def on_fit_start(self) -> None:
        if self._converged():  # the run that is resumed had ended
            self.trainer.should_stop = True

    # -- training ------------------------------------------------------------------------------------------------

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        optimizers = [self.optimizer_factory(self.mesh.parameters())]
        if self.weights["adversarial"]:
            optimizers.append(self.critic_optimizer_factory(self.critic.parameters()))
        return optimizers

    def _optimizers(self) -> tuple[Any, Any]:
        """The mesh's and the critic's, None if it is not trained."""
        found = self.optimizers()
        return (found[0], found[1]) if isinstance(found, list) else (found, None)

    def on_train_epoch_start(self) -> None:
        due = self.levels.due(self.current_epoch)
        if due > self.level or self.current_epoch == 0:
            self.level, self.overall = due, {}
            if self.mesh.subdivide_to(self.levels[due].faces, least=self.gsd):
                optimizer = self._optimizers()[0].optimizer
                optimizer.state.clear()
                optimizer.param_groups[0]["params"] = list(self.mesh.parameters())
                log.info("level %d: %d faces", due + 1, len(self.mesh.faces))
        self.mesh.forget_errors()

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        mesh_optimizer, critic_optimizer = self._optimizers()
        random = step_random(self.seed, self.current_epoch, batch_idx, self.global_rank)
        shrink = self.levels[self.level].shrink
        shot, present = shot_of(batch, shrink=shrink), self.mesh.prepared()
        rendered = present.seen_by(shot.views, background=shot.image)
        mask = self._mask(rendered, shot)
        values: dict[str, Tensor] = {}
        terms = {"reconstruction": self._reconstruction(rendered, shot, mask)}
        if self.weights["consistency"]:
            near = shot_of(batch, shrink=shrink, of="other_")
            terms["consistency"] = self._consistency(present, rendered, shot, near, mask)
        if critic_optimizer is not None:
            values |= self._critic_steps(critic_optimizer, rendered.image.detach(), shot.image, mask, random)
            fake, _ = self._patches(rendered.image, shot.image, mask, random)
            self.critic.requires_grad_(False)
            terms["adversarial"] = image_losses.adversarial(self.critic(fake)).mean()
            self.critic.requires_grad_(True)
        terms |= self.mesh.shape_terms(present.vertices, self.weights)
        loss = torch.stack([self.weights.get(name, 1.0) * value for name, value in terms.items()]).sum()
        self._schedule(mesh_optimizer, batch_idx)
        mesh_optimizer.zero_grad()
        self.manual_backward(loss)
        mesh_optimizer.step()
        self.mesh.add_error(rendered, shot.image, shot.valid)
        before = self.overall.get(self.current_epoch, 0.0) if batch_idx else 0.0
        self.overall[self.current_epoch] = before + (float(loss.detach()) - before) / (batch_idx + 1)
        named = {f"loss_{name}": value.detach() for name, value in terms.items()}
        self._report("train", {"loss": loss.detach(), **named, **values}, len(shot.image))

    def on_train_epoch_end(self) -> None:
        if self._converged():
            self.trainer.should_stop = True

    def _converged(self) -> bool:
        """Whether the overall loss has converged under the threshold (section 3.2) in the last level."""
        losses = [self.overall[epoch] for epoch in sorted(self.overall)]
        if self.level < self.levels.last or not converged(losses, threshold=self.threshold, tolerance=self.tolerance):
            return False
        limit = "" if self.threshold is None else f" under the threshold of {self.threshold:g}"
        self.stopped_by = f"the overall loss, which converged at {min(losses[-PATIENCE:]):.4g}{limit}"
        return True

    def _mask(self, rendered: Rendered, shot: Shot) -> Tensor:
        mask = shot.covered(rendered)
        if self.robust is None or self.level == 0:
            return mask
        return image_losses.robust_mask(rendered.image.detach(), shot.image, mask, k=self.robust)

    def _reconstruction(self, rendered: Rendered, shot: Shot, mask: Tensor) -> Tensor:
        image = rendered.image
        if self.exposure:
            image = image * self.exposures(image, shot, mask)[:, :, None, None]
        options = {name: self.weights[name] for name in SIMILARITY}
        return image_losses.reconstruction(image, shot.image, mask=mask, **options).mean()

    def _consistency(self, present: Prepared, rendered: Rendered, shot: Shot, near: Shot, mask: Tensor) -> Tensor:
        with torch.no_grad():
            depth = present.seen_by(near.views).depth
        photograph = torch.cat([near.image, near.valid[:, None].to(near.image)], 1)
        carried, known = reproject(photograph, near.views, depth, rendered, shot.views)
        carried, valid = carried[:, :3], carried[:, 3].detach() > COVERED
        seen = mask * (known & valid)
        if self.exposure:
            carried = carried * image_losses.gains(carried, shot.image, seen).detach()[:, :, None, None]
        return (1 - image_losses.ssim(carried, shot.image, mask=seen)).mean()

    def _critic_steps(
        self, optimizer: Any, fake: Tensor, real: Tensor, mask: Tensor, random: torch.Generator
    ) -> dict[str, Tensor]:
        for _ in range(self.critic_steps):
            virtual, true = self._patches(fake, real, mask, random)
            mix = torch.rand(len(true), generator=random).to(true.device)
            on_real, on_fake = self.critic(true), self.critic(virtual)
            penalty = image_losses.gradient_penalty(self.critic, true, virtual, mix)
            loss = (image_losses.critic(on_real, on_fake) + self.weights["theta"] * penalty).mean()
            optimizer.zero_grad()
            self.manual_backward(loss)
            optimizer.step()
        apart = (on_real - on_fake).detach().mean()
        return {"critic_distance": apart, "gradient_penalty": penalty.detach().mean()}

    def _patches(self, fake: Tensor, real: Tensor, mask: Tensor, random: torch.Generator) -> tuple[Tensor, Tensor]:
        return patches(fake, real, mask, count=self.patches, size=self.patch_size, random=random)

    def _schedule(self, optimizer: Any, batch_idx: int) -> None:
        """The learning rate falls in every level."""
        batches = float(self.trainer.num_training_batches)
        inside = batch_idx / batches if math.isfinite(batches) and batches else 0.0
        for group in optimizer.param_groups:
            group["lr"] = optimizer.defaults["lr"] * self.levels.rate(self.level, self.current_epoch + inside)

    # -- measuring -----------------------------------------------------------------------------------------------

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        self._report("val", self.measure(batch), len(batch["image"]))

    def on_validation_epoch_end(self) -> None:
        shape = getattr(self.trainer.datamodule, "shape", None)  # type: ignore[attr-defined]
        if shape is not None:
            with torch.no_grad():
                vertices, _ = self.mesh()
            self._report("val", shape(vertices.cpu().numpy(), self.mesh.faces.cpu().numpy()), 1)

    @torch.no_grad()
    def measure(self, batch: Batch, mesh: Prepared | None = None) -> dict[str, Tensor]:
        """Eq. 6 and its three measures, over the pixels that the mesh covers, exposures as they are.

        Args:
            batch: of photographs.
            mesh: another one than the present.
        """
        shot, rendered = self._observed(batch, mesh)
        image, photograph, mask = rendered.image, shot.image, shot.covered(rendered)
        options = {name: self.weights[name] for name in SIMILARITY}
        return {
            "loss": image_losses.reconstruction(image, photograph, mask=mask, **options).mean(),
            "psnr_db": image_losses.psnr(image, photograph, mask=mask).mean(),
            "ssim": image_losses.ssim(image, photograph, mask=mask).mean(),
            "nc": image_losses.nc(image, photograph, mask=mask).mean(),
            "covered": mask.mean(),
        }

    @torch.no_grad()
    def observe(self, batch: Batch, mesh: Prepared | None = None) -> Tensor:
        """What a mesh looks like from the batch's cameras [B, 3, H, W]; the photograph where it shows nothing."""
        return self._observed(batch, mesh)[1].image

    def _observed(self, batch: Batch, mesh: Prepared | None) -> tuple[Shot, Rendered]:
        shot = shot_of(batch)
        shown = self.mesh.prepared() if mesh is None else mesh
        return shot, shown.seen_by(shot.views, background=shot.image)

    def _report(self, split: str, values: Mapping[str, Tensor | float], count: int) -> None:
        named = {f"{split}/{name}": value for name, value in values.items()}
        self.log_dict(named, on_step=False, on_epoch=True, batch_size=count)
