"""What no run can mean is refused in one sentence before anything is rendered or trained."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from types import ModuleType

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf

from overfly.checks import check_overrides
from overfly.configuration import build, check, conf_dir, explain, register_resolvers

EXPERIMENTS = sorted(path.stem for path in conf_dir().glob("experiment/*.yaml"))


@pytest.fixture(autouse=True)
def _hydra() -> Iterator[None]:
    register_resolvers()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        yield


def sentence(*overrides: str) -> str | None:
    """What is said to somebody who types these overrides; None if nothing is wrong."""
    try:
        cfg = compose("train", overrides=["run_dir=run", "cache_dir=cache", *overrides])
        check_overrides(cfg, overrides, conf_dir())
        check(cfg)
        build(cfg.data)
        if cfg.stage is not None:  # with stage=all the number of epochs is a phase's
            build(OmegaConf.merge(cfg.trainer, {"callbacks": None, "logger": False}))
        if "_target_" in cfg.model:
            build(cfg.model)
    except Exception as error:
        said = explain(error)
        if said is None:
            raise
        assert "\n" not in said
        return said
    return None


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_may_set_what_it_likes(experiment: str) -> None:
    assert sentence(f"experiment={experiment}", "trainer.accelerator=cpu") is None


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ("experiment=paper_table1 altitude=100", "altitude=100 would be ignored.*add data.source.cells=null"),
        ("experiment=paper_table1 overlap=[30,50]", "add data.source.cells=null"),
        ("experiment=paper_table1 data.source.altitude=100", "add data.source.cells=null"),
        ("experiment=paper_table1 data.source.flight_paths=[grid,circular]", "add data.source.cells=null"),
        ("experiment=overfly_small flight_path=grid", "add data.source.flight_paths=null"),
        ("experiment=overfly_small +flight_path.heading_deg=5", "add data.source.flight_paths=null"),
        ("data=folder data.root=flown altitude=100", "as they were flown.*leave altitude out"),
        ("data=folder data.root=flown flight_path=grid", "as they were flown.*leave flight_path out"),
        ("stage=ssgan3d data.flight=flown side_overlap=40", "add data.flight=null"),
        ("stage=ssgan3d data.flight=flown data.synthetic.frames=9", "add data.flight=null"),
        ("stage=ssgan3d frames=2", "without windows.*leave frames out"),
        ("experiment=atlas model=gan_decoder", "give another from_run"),
        (
            "experiment=overfly_small data.batch_size=2 stage=all",
            "phases.encoder.data.batch_size=2 phases.gan.data.batch_size=2 phases.full.data.batch_size=2",
        ),
        ("experiment=overfly_small data.batch_size=4", r"type phases.encoder.data.batch_size=4\.$"),
        ("stage=all monitor=val/loss", "type phases.gan.monitor=val/loss phases.full.monitor=val/loss"),
        ("experiment=overfly_base loss.height=3", r"type phases.full.loss.height=3\.$"),
        ("stage=all +stage.epochs=1", "phases.encoder.stage.epochs=1 .*or trainer.max_epochs=1 for all"),
        ("stage=all +stage.pixels=1", "phases.encoder.stage.pixels=1"),
        ("experiment=demo stage=gan phases.gan.stage.epochs=1", "stage=gan has no phases"),
        ("experiment=smoke stage=gan stage.epochs=1", r"type trainer.max_epochs=1\.$"),
        ("experiment=smoke phases.gan.stage.epochs=1", r"type \+phases.gan.trainer.max_epochs=1\.$"),
    ],
)
def test_what_was_typed_is_not_ignored(overrides: str, says: str) -> None:
    said = sentence(*overrides.split())
    assert said is not None
    assert re.search(says, said), said


@pytest.mark.parametrize(
    "overrides",
    [
        "experiment=paper_table1 altitude=100 data.source.cells=null",
        "experiment=paper_table1 side_overlap=40 flight_path=grid",
        "experiment=overfly_small flight_path=grid data.source.flight_paths=null",
        "experiment=overfly_small phases.full.data.batch_size=2",
        "experiment=overfly_base loss.height=3 phases.full.loss.height=4",
        "stage=gan stage.epochs=3",
        "experiment=smoke stage=gan stage.epochs=3 trainer.max_epochs=1",  # the latter may come from resume
        "stage=ssgan3d altitude=100 flight_path=circular data.synthetic.frames=8",
        "stage=all trainer.max_epochs=1 loss=geometry_only model=gan_decoder",
        "+flight_path.heading_deg=45",
        "data.source.flight_paths=grid",
    ],
)
def test_what_is_read_may_be_typed(overrides: str) -> None:
    assert sentence(*overrides.split()) is None


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ("overlap=[30,50", "type KEY=VALUE"),
        ("stage", "'stage' cannot be read: type KEY=VALUE"),
        ("=3", "no key before its =, or a number where a name is meant"),
        ("seed=abc", "from 0 to 4294967295"),
        ("seed=-1", "from 0 to 4294967295"),
        ("seed=1.5", "from 0 to 4294967295"),
        ("points=abc", "a whole number, 1 or more"),
        ("altitude=[]", "altitude=[] is not possible"),
        ("loss.chamfer=abc", "a number, 0 or more"),
        ("loss.chamfer=nan", "a number, 0 or more"),
        ("loss.chamfer=inf", "a number, 0 or more"),
        ("loss.chamfer=-1", "a number, 0 or more"),
        ("phases.full.loss.height=-1 experiment=overfly_base", "loss.height=-1 is not possible"),
        ("data.batch_size=0", "data.batch_size=0 is not possible"),
        ("data.batch_size=abc", "data.batch_size=abc is not possible"),
        ("data.workers=-1", "a whole number, 0 or more"),
        ("data.source.images.train=abc", "data.source.images.train=abc is not possible"),
        ("data.source.images.val=-3", "data.source.images.val=-3 is not possible"),
        ("data.source.cells=[{altitude:100}]", "share (above 0)"),
        ("+flight_path.foo=45", "'flight_path.foo' is unknown"),
        ("stage=gan stage.optimizer.lr=-1", "stage.optimizer.lr=-1 is not possible"),
        ("stage=gan stage.epochs=0", "stage.epochs=0 is not possible"),
        ("experiment=atlas every=0", "every=0 is not possible"),
        ("experiment=atlas draws=-1", "draws=-1 is not possible"),
        ("trainer.max_epochs=abc", "trainer.max_epochs=abc is not possible"),
        ("trainer.max_epochs=0", "trainer.max_epochs=0 is not possible"),
        ("trainer.limit_train_batches=0", "trainer.limit_train_batches=0 is not possible"),
        ("stage=gan trainer.accelerator=tpuu", "trainer cannot be built as it is configured"),
        ("stage=gan trainer.precision=32x", "Precision '32x' is invalid"),
        ("stage=gan +trainer.foo=3", "unexpected keyword argument 'foo'"),
        ("stage=gan monitor=chamfer", "such as monitor=val/loss"),
        ("stage=gan model=free_vertices", "model=gan_decoder or model=local_decoder or model=sweep_decoder"),
        ("stage=ssgan3d model=gan_decoder", "choose model=free_vertices or model=mesh_generator"),
        ("stage=gan data=photographs", "learns from data=synthetic or data=folder"),
        ("stage=ssgan3d data=synthetic", "learns from data=photographs"),
        ("experiment=smoke data=folder data.root=flown", "data=folder has no key data.source.styles"),
        ("model._target_=mine.Typo", "in the working folder or on PYTHONPATH"),
    ],
)
def test_what_is_not_possible_is_one_sentence(overrides: str, says: str) -> None:
    assert says in (sentence(*overrides.split()) or "")


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (
            "stage=ssgan3d cameras=estimated",
            "belongs to stage=evaluate: add that, or leave cameras out. Or did you mean",
        ),
        ("stage=ssgan3d cameras=estimated", "data.cameras?"),
        ("stage=all stage.epochs=1", "phases.full.stage.epochs (or trainer.max_epochs, for all phases)"),
        ("loss.chamfr=3", "Did you mean loss.chamfer?"),
        ("trainer.max_epoch=2", "Did you mean trainer.max_epochs?"),
        ("trainr.max_epochs=2", "Did you mean trainer.max_epochs?"),
        ("data.batchsize=3", "Did you mean data.batch_size?"),
        ("data.cells=null", "Did you mean data.source.cells?"),
        ("data.root=flown", "belongs to data=folder: add that"),
        ("loss=paper loss.height=3", "belongs to loss=surface: add that"),
        ("stage=gan phases.gan.stage.epochs=1", "Did you mean stage.epochs?"),
    ],
)
def test_advice_about_a_key_that_does_not_exist_works(overrides: str, says: str) -> None:
    assert says in (sentence(*overrides.split()) or "")


def test_a_part_of_ones_own_that_fails_is_not_taken_for_a_wrong_value(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise ValueError("a bug")

    module = ModuleType("mine")
    module.broken = broken  # type: ignore[attr-defined]
    broken.__module__ = "mine"
    monkeypatch.setitem(sys.modules, "mine", module)
    with pytest.raises(InstantiationException) as error:
        build(DictConfig({"_target_": "mine.broken"}))
    assert explain(error.value) is None
