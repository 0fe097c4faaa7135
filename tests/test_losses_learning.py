"""The losses of encoder and players: hand values, what they reward, gradients in double."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn import functional as F

from overfly import losses


def test_correspondence_by_hand() -> None:
    # Two cells with similarities 1 and 0 to the query, temperature 1: -log(e / (e + 1)) at the first cell's centre.
    cells = torch.tensor([[[[1.0, 0.0]], [[0.0, 1.0]]]])  # [1, C = 2, h = 1, w = 2]
    query = torch.tensor([[[1.0, 0.0]]])
    first = losses.correspondence(query, cells, torch.tensor([[[0.5, 0.5]]]), temperature=1.0)
    assert first.item() == pytest.approx(-math.log(math.e / (math.e + 1)))
    between = losses.correspondence(query, cells, torch.tensor([[[1.0, 0.5]]]), temperature=1.0)
    assert between.item() == pytest.approx(-0.5 * math.log(math.e / (math.e + 1)) - 0.5 * math.log(1 / (math.e + 1)))


def test_correspondence_of_a_map_that_knows_nothing_is_the_log_of_its_cells() -> None:
    same = F.normalize(torch.ones(2, 4, 6, 5), dim=1)
    values = losses.correspondence(F.normalize(torch.ones(2, 3, 4), dim=2), same, torch.rand(2, 3, 2) * 5)
    assert torch.allclose(values, torch.full((2, 3), math.log(30)), atol=1e-5)


def test_correspondence_agrees_with_cross_entropy_at_cell_centres() -> None:
    generator = torch.Generator().manual_seed(0)
    cells = F.normalize(torch.randn(2, 8, 5, 7, generator=generator), dim=1)
    queries = F.normalize(torch.randn(2, 6, 8, generator=generator), dim=2)
    target = torch.randint(0, 35, (2, 6), generator=generator)
    places = torch.stack([target % 7, target // 7], -1) + 0.5
    expected = F.cross_entropy((queries @ cells.flatten(2) / 0.07).flatten(0, 1), target.flatten(), reduction="none")
    assert torch.allclose(losses.correspondence(queries, cells, places).flatten(), expected, atol=1e-4)


def test_retrieval_by_hand_and_what_it_ignores() -> None:
    descriptors = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    positive = torch.zeros(4, 4, dtype=torch.bool)
    positive[0, 1] = positive[1, 0] = True
    negative = torch.zeros(4, 4, dtype=torch.bool)
    negative[0, 2] = True  # the fourth is neither: it must not count
    values = losses.retrieval(descriptors, positive, negative, temperature=1.0)
    assert values[0].item() == pytest.approx(-math.log(math.e / (math.e + 1)))
    assert values[1].item() == pytest.approx(0.0, abs=1e-6)  # nothing stands against it
    assert values[2:].tolist() == [0.0, 0.0]  # no positive
    positive.fill_diagonal_(True)
    assert torch.allclose(losses.retrieval(descriptors, positive, negative, temperature=1.0), values)


def test_players_by_hand() -> None:
    logits = torch.tensor([0.0, math.log(3)])  # D = 1/2, 3/4
    assert torch.allclose(losses.adversarial(logits), -torch.log(torch.tensor([0.5, 0.75])))
    assert torch.allclose(losses.adversarial_eq1(logits), torch.log(torch.tensor([0.5, 0.25])))
    undecided = losses.discriminator(torch.zeros(1), torch.zeros(1))
    assert undecided.item() == pytest.approx(math.log(2))
    # The discriminator minimises half the negative of Eq. 1; the generator's share of Eq. 1 is its second term.
    real, generated = torch.tensor([0.3]), torch.tensor([-0.8])
    eq1 = torch.log(torch.sigmoid(real)) + torch.log(1 - torch.sigmoid(generated))
    assert torch.allclose(losses.discriminator(real, generated), -eq1 / 2)


def test_the_non_saturating_form_still_pushes_where_eq1_is_flat() -> None:
    losing = torch.tensor([-8.0], requires_grad=True)
    push = [
        torch.autograd.grad(f(losing).sum(), losing)[0].item() for f in (losses.adversarial, losses.adversarial_eq1)
    ]
    assert push[0] < -0.99
    assert -1e-3 < push[1] < 0  # the same direction


def test_correction_by_hand() -> None:
    predicted = torch.zeros(2, 6)
    true = torch.tensor([[0.0, 0, 0, 0, 0, 0], [0.005, 0, 0, 0.03, 0, 0]])
    # Quadratic below beta = 0.01: 0.5 x^2 / beta; linear above: |x| - beta / 2.
    assert losses.correction(predicted, true).tolist() == pytest.approx([0.0, 0.00125 + 0.025])


def test_gradients_in_double() -> None:
    generator = torch.Generator().manual_seed(3)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()

    places = torch.rand(2, 3, 2, generator=generator, dtype=torch.float64) * 3
    positive = torch.tensor([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, 1, 0]], dtype=torch.bool)
    check = torch.autograd.gradcheck
    assert check(lambda q, m: losses.correspondence(q, m, places, 0.5), (random(2, 3, 4), random(2, 4, 3, 3)))
    assert check(lambda d: losses.retrieval(d, positive, ~positive, 0.5), (random(4, 5),))
    assert check(lambda p, t: losses.correction(p, t), (random(2, 6), random(2, 6)))
    assert check(losses.adversarial, (random(5),))
    assert check(losses.adversarial_eq1, (random(5),))
    assert check(losses.discriminator, (random(5), random(5)))
