"""What a stage takes over from another run, and what it says about it."""

from __future__ import annotations

import pytest
import torch
from test_training import make_stage

from overfly.errors import InputError
from terrain import make_network


def trained(*parts: str) -> dict[str, torch.Tensor]:
    """The state dict of a stage whose parts have other weights than a fresh network's."""
    stage = make_stage("encoder")
    for name in parts:
        stage.part(name).steps += 12
        for value in stage.part(name).parameters():
            torch.nn.init.constant_(value, 0.01)
    return stage.state_dict()


def test_the_gan_takes_the_encoder_and_starts_its_blocks_from_it() -> None:
    stage, state = make_stage("gan"), trained("encoder")
    lines = stage.warm_start(state, "outputs/encoder/x/best.ckpt")
    assert lines == [
        "encoder: from outputs/encoder/x/best.ckpt (12 training steps)",
        "discriminator: untrained in outputs/encoder/x/best.ckpt, starts at random (seeded)",
        "generator: its 10 residual blocks start as the encoder's blocks 2 3 2 3 2 3 2 3 2 3",
    ]
    for key, value in stage.part("encoder").state_dict().items():
        assert torch.equal(value, state[f"network.encoder.{key}"])
    kernel = stage.network.generator.blocks[9].residual[0].weight  # type: ignore[union-attr, index]
    assert torch.equal(kernel, torch.full_like(kernel, 0.01))


def test_the_full_stage_takes_all_parts() -> None:
    stage, state = make_stage("full"), trained("encoder", "generator", "discriminator")
    lines = stage.warm_start(state, "run")
    assert [line.split(":")[0] for line in lines] == ["encoder", "generator", "discriminator"]
    assert all("from run (12 training steps)" in line for line in lines)
    stage.setup("fit")  # must not overwrite the generator's blocks with the encoder's
    for key, value in stage.state_dict().items():
        if key.startswith("network."):
            assert torch.equal(value, state[key]), key


def test_weights_of_another_network_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"other network|another shape are network\.encoder") as caught:
        make_stage("gan", network=make_network(encoder={"descriptor": 8})).warm_start(trained("encoder"), "run")
    assert "retrieval_head" in str(caught.value)
    state = trained("encoder")
    del state["network.encoder.stem.0.weight"]
    with pytest.raises(InputError, match=r"lacks network\.encoder\.stem\.0\.weight"):
        make_stage("gan").warm_start(state, "run")
    state = trained("encoder") | {"network.encoder.extra": torch.zeros(1)}
    with pytest.raises(InputError, match=r"besides network\.encoder\.extra"):
        make_stage("gan").warm_start(state, "run")


def test_a_run_that_trained_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="trained nothing"):
        make_stage("gan").warm_start(trained(), "run")
