"""Retrieval top-1 over a whole split, where a hit is a frame that sees common ground."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat


class RetrievalTop1(Metric):
    """Share of frames whose nearest other frame, by descriptor, overlaps them on the ground.

    The gallery of a frame is its own window and all windows of other scenes; other windows of its own scene are left
    out, since how much they overlap it is unknown. Frames that overlap no other are not asked. NaN if none was.
    A negative overlap marks the same frame, which is no candidate.
    """

    full_state_update = False
    higher_is_better = True
    descriptors: list[Tensor]
    overlaps: list[Tensor]
    scenes: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        for name in ("descriptors", "overlaps", "scenes"):
            self.add_state(name, [], dist_reduce_fx="cat")

    def update(self, descriptors: Tensor, overlaps: Tensor, scenes: Tensor) -> None:
        """Add windows: descriptors [B, K, D], overlaps [B, K, K], scenes [B]."""
        self.descriptors.append(descriptors.detach())
        self.overlaps.append(overlaps)
        self.scenes.append(scenes)

    def compute(self) -> Tensor:
        descriptors, overlaps, scenes = (dim_zero_cat(x) for x in (self.descriptors, self.overlaps, self.scenes))
        hits, asked = (x.sum() for x in window_hits(descriptors, overlaps, scenes))
        return hits / asked if asked else torch.tensor(float("nan"))


SHORTLIST = 60
"""Images nearest by descriptor among which correspondences decide."""

Verify = Callable[[int, Tensor], Tensor]


def window_hits(
    descriptors: Tensor, overlaps: Tensor, scenes: Tensor, verify: Verify | None = None
) -> tuple[Tensor, Tensor]:
    """How many frames of each window find a frame that overlaps them, and how many overlap any: both [n].

    Args:
        descriptors: [n, K, D], all windows of a split.
        overlaps: [n, K, K].
        scenes: [n].
        verify: of a frame's number in the gallery and those of the shortlist [R], how well each shows its place [R];
            None takes the first of the list.
    """
    n, k = descriptors.shape[:2]
    gallery, frame_scene = descriptors.flatten(0, 1), scenes.repeat_interleave(k)
    window = torch.arange(n, device=scenes.device).repeat_interleave(k)
    diagonal = torch.eye(k, dtype=torch.bool, device=scenes.device)
    hits, asked = torch.zeros(2, n)
    for w in range(n):  # a window at a time: the whole matrix would grow with the square of the split
        itself = diagonal | (overlaps[w] < 0)
        likeness = descriptors[w] @ gallery.T  # [K, n K]
        likeness[:, (frame_scene == scenes[w]) & (window != w)] = -torch.inf
        likeness[:, w * k : (w + 1) * k].masked_fill_(itself, -torch.inf)
        common = (overlaps[w] > 0) & ~itself
        best = likeness.argmax(1)
        for i in range(k):
            if verify is not None and common[i].any():
                listed = likeness[i].topk(min(SHORTLIST, int(torch.isfinite(likeness[i]).sum()))).indices
                best[i] = listed[verify(w * k + i, listed).argmax()]
        own = (best // k) == w
        hit = own & common.gather(1, torch.where(own, best % k, torch.zeros_like(best))[:, None])[:, 0]
        some = common.any(1)
        hits[w], asked[w] = (hit & some).sum(), some.sum()
    return hits, asked
