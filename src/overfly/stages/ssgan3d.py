"""SS-GAN-3D: a rough mesh is refined by rendering it where the photographs were taken (second paper, section 3)."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence, Sized
from typing import Any, NamedTuple, Protocol, cast

import lightning as L
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from overfly import image_losses, mesh_losses
from overfly.errors import InputError, unknown
from overfly.rendering.render import Rendered, Views, render
from overfly.rendering.reproject import reproject
from overfly.rendering.subdivision import subdivide, wanted
from overfly.rendering.topology import Topology, topology
from overfly.stages.stage import Batch, OptimizerFactory, step_random

log = logging.getLogger("overfly")

WEIGHTS = (
    "alpha", "beta", "gamma", "centre", "slope", "adversarial", "theta",
    "consistency", "laplacian", "normal_consistency", "edge_length",
)  # fmt: skip

PATIENCE = 3
"""Epochs in which the overall loss must not have fallen any more, to have converged."""

COVERED = 0.999
"""Antialiased coverage above which a pixel counts as shown by the mesh alone."""


class Mesh(Protocol):
    """A mesh as :class:`overfly.mesh.Mesh` holds it."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None


class Prepared(NamedTuple):
    """A mesh that can be rendered: vertices [V, 3], local metres, colours [V, 3] in 0..1, and its connections."""

    vertices: Tensor
    colors: Tensor
    sides: Topology


class Shots(Protocol):
    """What the stage asks of its data module, after ``setup``."""

    mesh: Mesh
    gsd: float
    photographs: Sized


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
        patch_size: pixels, at most the smallest image's height.
        critic_steps: steps of the critic before each of the generator.
        robust: robust standard deviations above which a pixel counts as moved or foreign, from the second level on;
            None: never.
        exposure: whether each photograph's exposure is estimated.
        threshold: overall loss under which training may stop; None: whatever the loss.
        tolerance: share of the loss; 0: never stop early.
        seed: of everything that is drawn.

    Raises:
        InputError: a weight is unknown, or nothing would be compared.
    """

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
        self.epochs, self.levels = epochs, [dict(level) for level in levels]
        self.step_gsd, self.patches, self.patch_size, self.critic_steps = step_gsd, patches, patch_size, critic_steps
        self.robust, self.exposure, self.threshold, self.tolerance = robust, exposure, threshold, tolerance
        self.seed, self.level = seed, 0
        self.generator: nn.Module | None = None
        self.register_buffer("faces", torch.zeros(0, 3, dtype=torch.int32))
        self.register_buffer("log_gains", torch.zeros(0, 3))
        self.sides: Topology | None = None
        self.edge_m = 1.0
        self.error: np.ndarray | None = None
        self.overall: list[float] = []
        self.stopped_by = "the number of epochs"

    # -- the mesh ------------------------------------------------------------------------------------------------

    def configure_model(self) -> None:
        """Start from the data module's mesh."""
        if self.generator is None:
            data = cast(Shots, self.trainer.datamodule)  # type: ignore[attr-defined]
            assert data.mesh.colors is not None
            vertices = torch.from_numpy(np.asarray(data.mesh.vertices)).float()
            colors = torch.from_numpy(np.asarray(data.mesh.colors)).float() / 255
            self.generator = self.make_generator(vertices, colors, step=self.step_gsd * data.gsd).to(self.device)
            self._connect(torch.from_numpy(np.asarray(data.mesh.faces)).int())
            self.log_gains = torch.zeros(len(data.photographs), 3, device=self.device)
            self.gsd = float(data.gsd)

    def mesh(self) -> tuple[Tensor, Tensor]:
        """The present vertices [V, 3], local metres, and colours [V, 3] in 0..1."""
        assert self.generator is not None
        vertices, colors = self.generator()
        return vertices, colors

    def _connect(self, faces: Tensor) -> None:
        assert self.generator is not None
        self.faces = faces.to(self.device)
        with torch.no_grad():
            vertices, _ = self.mesh()
        self.sides = topology(self.faces, len(vertices))
        a, b = self.sides.edges.unbind(1)
        self.edge_m = float((vertices[a] - vertices[b])[:, :2].norm(dim=1).median())

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["refinement"] = {"level": self.level, "overall": self.overall}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """The mesh of a later level has other faces than the one that this run would start from."""
        self.level, self.overall = checkpoint["refinement"]["level"], list(checkpoint["refinement"]["overall"])
        self.faces = checkpoint["state_dict"]["faces"].clone()
        self.sides = None

    def on_fit_start(self) -> None:
        if self.sides is None:  # a checkpoint was loaded
            self._connect(self.faces)

    def warm_start(self, state: Mapping[str, Tensor], source: str) -> list[str]:
        raise InputError(
            f"A refinement starts from a mesh, not from the weights in {source}: give its refined.ply as data.mesh=..."
        )

    # -- training ------------------------------------------------------------------------------------------------

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        assert self.generator is not None
        optimizers = [self.optimizer_factory(self.generator.parameters())]
        if self.weights["adversarial"]:
            optimizers.append(self.critic_optimizer_factory(self.critic.parameters()))
        return optimizers

    def on_train_epoch_start(self) -> None:
        due = min(self.trainer.current_epoch * len(self.levels) // self.epochs, len(self.levels) - 1)
        while self.level < due:
            self.level += 1
        self._refine_to(int(self.levels[self.level]["faces"]))
        assert self.sides is not None
        self.error = np.zeros(len(self.sides.faces))
        self.sums = [0.0, 0]

    def _refine_to(self, budget: int) -> None:
        assert self.generator is not None
        assert self.sides is not None
        start = len(self.sides.faces)
        for _ in range(8):
            faces, edges = (x.cpu().numpy().astype(np.int64) for x in (self.sides.faces, self.sides.edges))
            if len(faces) > 0.9 * budget:
                break
            with torch.no_grad():
                vertices, _ = self.mesh()
            length = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1).cpu().numpy().astype(np.float64)
            known = self.error is not None and len(self.error) == len(faces) and bool(self.error.any())
            error = self.error if known else np.ones(len(faces))
            assert error is not None
            halved = wanted(faces, edges, error, length, budget=min(budget, 4 * len(faces)), least=self.gsd)
            if not halved.any():  # edges are as short as the pixels
                break
            parents, new = subdivide(faces, edges, halved, len(vertices))
            self.generator = cast(Any, self.generator).subdivided(torch.from_numpy(parents).to(self.device))
            self._connect(torch.from_numpy(new).int())
            self.error = None
            optimizer = cast(Any, self.optimizers())
            optimizer = optimizer[0] if isinstance(optimizer, list) else optimizer
            optimizer.optimizer.state.clear()
            optimizer.optimizer.param_groups[0]["params"] = list(self.generator.parameters())
        if len(self.sides.faces) > start:
            log.info("level %d: %d faces", self.level + 1, len(self.sides.faces))

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        optimizers = self.optimizers()
        mesh_optimizer, critic_optimizer = optimizers if isinstance(optimizers, list) else (optimizers, None)
        random = step_random(self.seed, self.current_epoch, batch_idx, self.global_rank)
        shot, views = self._shot(batch)
        vertices, colors = self.mesh()
        rendered = self._render(vertices, colors, views, shot["image"])
        mask = self._mask(rendered, shot)
        values: dict[str, Tensor] = {}
        terms = self._image_terms(rendered, shot, mask)
        if self.weights["consistency"]:
            terms["consistency"] = self._consistency(vertices, colors, rendered, shot, views, mask)
        if critic_optimizer is not None:
            values |= self._critic_steps(critic_optimizer, rendered.image.detach(), shot["image"], mask, random)
            fake, _ = self._patches(rendered.image, shot["image"], mask, random)
            self.critic.requires_grad_(False)
            terms["adversarial"] = image_losses.adversarial(self.critic(fake)).mean()
            self.critic.requires_grad_(True)
        terms |= self._shape_terms(vertices)
        loss = torch.stack([self._weight(name) * value for name, value in terms.items()]).sum()
        self._schedule(mesh_optimizer, batch_idx)
        mesh_optimizer.zero_grad()
        self.manual_backward(loss)
        mesh_optimizer.step()
        self._collect_error(rendered, shot)
        self.sums[0] += float(loss.detach())
        self.sums[1] += 1
        named = {f"loss_{name}": value.detach() for name, value in terms.items()}
        self._report("train", {"loss": loss.detach(), **named, **values}, len(shot["image"]))

    def on_train_epoch_end(self) -> None:
        """Stop where the overall loss has converged under the threshold (section 3.2)."""
        self.overall.append(self.sums[0] / max(self.sums[1], 1))
        inside = len(self.overall) - self.level * self.epochs // len(self.levels)  # epochs of this level
        if self.level + 1 < len(self.levels) or inside <= PATIENCE or not self.tolerance:
            return
        before, now = min(self.overall[-inside:-PATIENCE]), min(self.overall[-PATIENCE:])
        low = self.threshold is None or now < self.threshold
        if low and before - now < self.tolerance * abs(before):
            limit = "" if self.threshold is None else f" under the threshold of {self.threshold:g}"
            self.stopped_by = f"the overall loss, which converged at {now:.4g}{limit}"
            self.trainer.should_stop = True

    def _weight(self, name: str) -> float:
        return 1.0 if name == "reconstruction" else self.weights[name]

    def _shot(self, batch: Batch, other: str = "") -> tuple[dict[str, Tensor], Views]:
        shrink = int(self.levels[self.level]["shrink"])
        image, valid = batch[f"{other}image"], batch[f"{other}valid"].float()
        intrinsics = batch[f"{other}intrinsics"]
        if shrink > 1:
            image = avg_pool2d(image, shrink)
            valid = (avg_pool2d(valid[:, None], shrink)[:, 0] > COVERED).float()
            intrinsics = intrinsics / torch.tensor([shrink, shrink, 1.0], device=intrinsics.device)[:, None]
        shot = {"image": image, "valid": valid, "index": batch["index"]}
        if not other and "other_image" in batch:
            shot["other"], near = self._shot(batch, "other_")  # type: ignore[assignment]
            shot["near"] = near  # type: ignore[assignment]
        views = Views(intrinsics, batch[f"{other}camera_from_local"], (image.shape[3], image.shape[2]))
        return shot, views

    def _render(self, vertices: Tensor, colors: Tensor, views: Views, background: Tensor | None) -> Rendered:
        assert self.sides is not None
        return render(vertices, colors, self.sides, views, background=background)

    def prepared(self, mesh: Mesh) -> Prepared:
        """A mesh on this stage's device, ready to be rendered."""
        assert mesh.colors is not None
        vertices = torch.from_numpy(np.asarray(mesh.vertices)).float().to(self.device)
        colors = torch.from_numpy(np.asarray(mesh.colors)).float().to(self.device) / 255
        faces = torch.from_numpy(np.asarray(mesh.faces)).int().to(self.device)
        return Prepared(vertices, colors, topology(faces, len(vertices)))

    def _present(self) -> Prepared:
        assert self.sides is not None
        return Prepared(*self.mesh(), self.sides)

    def _mask(self, rendered: Rendered, shot: Mapping[str, Tensor]) -> Tensor:
        mask = shot["valid"] * (rendered.coverage.detach() > COVERED)
        if self.robust is None or self.level == 0:
            return mask
        return image_losses.robust_mask(rendered.image.detach(), shot["image"], mask, k=self.robust)

    def _image_terms(self, rendered: Rendered, shot: Mapping[str, Tensor], mask: Tensor) -> dict[str, Tensor]:
        image = rendered.image
        if self.exposure:
            image = image * self._exposures(image.detach(), shot, mask)[:, :, None, None]
        options = {name: self.weights[name] for name in ("alpha", "beta", "gamma", "centre", "slope")}
        return {"reconstruction": image_losses.reconstruction(image, shot["image"], mask=mask, **options).mean()}

    @torch.no_grad()
    def _exposures(self, image: Tensor, shot: Mapping[str, Tensor], mask: Tensor) -> Tensor:
        """Gains [B, 3] of the photographs, smoothed over the steps; their mean over all photographs stays 1.

        With a gain of its own for each step the colours would be free to drift: whatever is too dark would be lit.
        """
        index = shot["index"]
        found = image_losses.gains(image, shot["image"], mask).log()
        self.log_gains[index] += 0.2 * (found - self.log_gains[index])
        return (self.log_gains[index] - self.log_gains.mean(0)).exp()

    def _consistency(
        self, vertices: Tensor, colors: Tensor, rendered: Rendered, shot: Mapping[str, Any], views: Views, mask: Tensor
    ) -> Tensor:
        other, near = shot["other"], shot["near"]
        with torch.no_grad():
            depth = self._render(vertices, colors, near, None).depth
        carried, known = reproject(other["image"], near, depth, rendered, views)
        seen = mask * known
        carried = carried * image_losses.gains(carried, shot["image"], seen).detach()[:, :, None, None]
        return (1 - image_losses.ssim(carried, shot["image"], mask=seen)).mean()

    def _shape_terms(self, vertices: Tensor) -> dict[str, Tensor]:
        """Regularisers, free of units: lengths in median edges."""
        assert self.sides is not None
        terms = {}
        if self.weights["laplacian"]:
            squared = mesh_losses.laplacian(vertices, self.sides.edges)
            terms["laplacian"] = (squared / self.edge_m**2 + 1e-8).sqrt().mean()
        if self.weights["normal_consistency"]:
            faces = self.sides.faces.long()
            terms["normal_consistency"] = mesh_losses.normal_consistency(vertices, faces, self.sides.pairs).mean()
        if self.weights["edge_length"]:
            terms["edge_length"] = (mesh_losses.edge_length(vertices, self.sides.edges) / self.edge_m**2).mean()
        return terms

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
        """The same places of rendering and photograph [B patches, 3, size, size]; the best covered of twice as many."""
        height, width = real.shape[2:]
        size = min(self.patch_size, height, width)
        tries = 2 * self.patches
        rows = torch.randint(height - size + 1, (len(real), tries), generator=random).tolist()
        columns = torch.randint(width - size + 1, (len(real), tries), generator=random).tolist()
        virtual, true = [], []
        for b in range(len(real)):
            places = [(slice(r, r + size), slice(c, c + size)) for r, c in zip(rows[b], columns[b], strict=True)]
            places.sort(key=lambda place: -float(mask[b][place].mean()))
            for place in places[: self.patches]:
                known = mask[b][place]
                true.append(real[b][:, *place])
                virtual.append(fake[b][:, *place] * known + real[b][:, *place] * (1 - known))
        return torch.stack(virtual), torch.stack(true)

    def _schedule(self, optimizer: Any, batch_idx: int) -> None:
        """The learning rate falls along a cosine in every level, to a tenth."""
        share = self.epochs / len(self.levels)
        batches = float(self.trainer.num_training_batches)
        inside = batch_idx / batches if math.isfinite(batches) and batches else 0.0
        done = min(max((self.current_epoch + inside - self.level * share) / share, 0.0), 1.0)
        for group in optimizer.param_groups:
            group["lr"] = optimizer.defaults["lr"] * max((1 + math.cos(math.pi * done)) / 2, 0.1)

    @torch.no_grad()
    def _collect_error(self, rendered: Rendered, shot: Mapping[str, Tensor]) -> None:
        """Add up each face's difference over the pixels that show it: where finer faces are worth their price."""
        shown = (rendered.face >= 0) & (shot["valid"] > 0)
        difference = (rendered.image - shot["image"]).abs().mean(1)
        assert self.error is not None
        faces, values = rendered.face[shown].cpu().numpy(), difference[shown].cpu().numpy()
        self.error += np.bincount(faces, values, len(self.error))

    # -- measuring -----------------------------------------------------------------------------------------------

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        self._report("val", self.measure(batch), len(batch["image"]))

    def on_validation_epoch_end(self) -> None:
        shape = getattr(self.trainer.datamodule, "shape", None)  # type: ignore[attr-defined]
        if shape is not None:
            with torch.no_grad():
                vertices, _ = self.mesh()
            self._report("val", shape(vertices.cpu().numpy(), self.faces.cpu().numpy()), 1)

    @torch.no_grad()
    def measure(self, batch: Batch, mesh: Prepared | None = None) -> dict[str, Tensor]:
        """Eq. 6 and its three measures, over the pixels that the mesh covers, exposures as they are.

        Args:
            batch: of photographs.
            mesh: another one than the present.
        """
        image, photograph, mask = self._observed(batch, mesh)
        options = {name: self.weights[name] for name in ("alpha", "beta", "gamma", "centre", "slope")}
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
        return self._observed(batch, mesh)[0]

    def _observed(self, batch: Batch, mesh: Prepared | None) -> tuple[Tensor, Tensor, Tensor]:
        photograph, valid, height = batch["image"], batch["valid"], batch["image"].shape[2:]
        views = Views(batch["intrinsics"], batch["camera_from_local"], (height[1], height[0]))
        vertices, colors, sides = self._present() if mesh is None else mesh
        rendered = render(vertices, colors, sides, views, background=photograph)
        return rendered.image, photograph, (valid & (rendered.coverage > COVERED)).float()

    def _report(self, split: str, values: Mapping[str, Tensor | float], count: int) -> None:
        named = {f"{split}/{name}": value for name, value in values.items()}
        self.log_dict(named, on_step=False, on_epoch=True, batch_size=count)
