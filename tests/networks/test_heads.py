"""The heads that read the encoder's maps: what they share with the sweep, and what they do not."""

from __future__ import annotations

import torch

from overfly.networks.encoder import Encoder
from overfly.networks.heads import PlaceHead, Pyramid

SIZES = {"features": 16, "descriptor": 8, "match_channels": 8, "correction_width": 8, "widths": (8, 8, 8, 8)}


def encoder(own_heads: bool) -> Encoder:
    torch.manual_seed(0)
    return Encoder(size=(64, 32), own_heads=own_heads, **SIZES).eval()  # type: ignore[arg-type]


def test_a_pyramid_gives_unit_vectors_at_half_and_context_at_a_quarter_of_the_image() -> None:
    maps = [torch.randn(2, c, 32 // s, 64 // s) for c, s in ((4, 2), (6, 4), (8, 8))]
    fine, context = Pyramid(widths=(4, 6, 8), channels=5)(maps)
    assert fine.shape == (2, 5, 16, 32)
    assert context.shape == (2, 5, 8, 16)
    torch.testing.assert_close(fine.norm(dim=1), torch.ones(2, 16, 32))


def test_matching_and_retrieval_do_not_move_what_the_sweep_compares() -> None:
    network = encoder(own_heads=True)
    encoded = network(torch.rand(2, 3, 32, 64))
    (encoded.match_map[:, 0].sum() + encoded.descriptor[:, 0].sum()).backward()
    moved = {name.split(".")[0] for name, p in network.named_parameters() if p.grad is not None and p.grad.any()}
    assert moved == {"own_heads"}


def test_without_own_heads_the_match_map_is_the_compared_one() -> None:
    images = torch.rand(1, 3, 32, 64)
    shared = encoder(own_heads=False).dense(images)
    assert torch.equal(shared.match_map, shared.compared)
    network = encoder(own_heads=True)
    own = network.dense(images)
    assert not torch.allclose(own.match_map, own.compared)
    assert torch.equal(network.dense(images, matching=False).match_map, own.compared)
    torch.testing.assert_close(own.match_map, network(images).match_map)


def test_a_place_is_told_by_its_parts_wherever_they_lie() -> None:
    torch.manual_seed(1)
    head = PlaceHead(inputs=6, clusters=4, outputs=12)
    ground = torch.randn(1, 6, 8, 24)
    left, right, elsewhere = ground[..., :16], ground[..., 8:], torch.randn(1, 6, 8, 16)
    with torch.no_grad():
        torch.testing.assert_close(head(left.roll(5, dims=3)), head(left))
        assert float((head(left) * head(right)).sum()) > float((head(left) * head(elsewhere)).sum())
