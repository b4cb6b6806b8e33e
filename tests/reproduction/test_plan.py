"""A plan: its arithmetic, what it gives to `train` and `eval`, and that another one is refused."""

import dataclasses
import json

import pytest
import tyro

from cref_jax import eval, train
from cref_jax.errors import ConfigError
from cref_jax.reproduction import plan as planning
from cref_jax.reproduction import progress
from cref_jax.reproduction.plan import EXPERIMENTS, Row

MORE = ("--run.chunk", "1", "--ppo.epochs", "3")


def build(variants=("full", "hpl"), seeds=(0, 4), **more):
    given = {"terrain": "mixed", "device": "cpu", "trials": 10, "samples": 20e6, **more}
    return planning.build(variants, seeds, **given)


def test_samples_are_whole_iterations_of_all_robots():
    # 256 robots x 24 steps are 6,144 samples: 20 M are 3,255.2 iterations, so 3,256 of them
    plan = build()
    assert [plan.configs[v].run.iterations for v in plan.variants] == [3256, 3256]
    assert plan.samples(Row("full", 4)) == 3256 * 6144
    # nine tenths are the teacher's: 2930.4
    assert plan.configs["hpl"].distillation.teacher_iterations == 2930
    # 100 robots: 2,400 samples per iteration
    assert build(num_envs=100).configs["full"].run.iterations == 8334
    # the paper's: 20,000 iterations of 4096 robots
    paper = build(samples=None, device="gpu")
    assert paper.samples(Row("full", 0)) == 20_000 * 4096 * 24


def test_a_whole_table_with_the_first_seed_comes_first():
    names = [row.name for row in build().rows]
    assert names == ["full-seed0", "hpl-seed0", "full-seed4", "hpl-seed4"]


def test_variants_differ_in_the_network_or_in_one_weight_of_the_reward_and_hpl_in_the_readout():
    plan = build(EXPERIMENTS, settings=MORE)
    full = plan.configs["full"]
    own = lambda c: (c.network.variant, c.network.convolutions, c.distillation.teacher_iterations)
    weights = {"foothold_placement", "foot_contact_quality"}
    for name, c in plan.configs.items():
        reward = c.reward if own(c) == own(full) else full.reward
        network = dataclasses.replace(
            c.network, variant="full", convolutions=full.network.convolutions
        )
        expected = dataclasses.replace(full, reward=reward, distillation=c.distillation)
        if name == "hpl":  # its teacher is given the ground, which the readout is there to find
            without = dataclasses.replace(full.ppo, readout_weight=0.0)
            expected = dataclasses.replace(expected, ppo=without)
        assert dataclasses.replace(c, network=network) == expected, name
        mine, theirs = (dataclasses.asdict(x.reward.weights) for x in (c, full))
        assert {key for key in mine if mine[key] != theirs[key]} <= weights
        rest = dataclasses.replace(c.reward, weights=full.reward.weights)
        assert rest == full.reward


@pytest.mark.parametrize("variant", ["full", "hpl"])
def test_train_makes_the_plans_settings_of_the_words_that_it_is_given(tmp_path, variant):
    plan, row = build(settings=MORE, num_envs=64), Row(variant, 4)
    command, *words = planning.train_words(plan, row, tmp_path, resume=False)
    _, c = train.parse(words)
    expected = plan.configs[variant]
    assert command == "train"
    assert c == dataclasses.replace(expected, run=dataclasses.replace(expected.run, seed=4))
    command, *words = planning.train_words(plan, row, tmp_path, resume=True)
    assert tyro.cli(train.Options, args=words).resume


def test_the_engine_and_the_devices_are_given_to_each_training(tmp_path):
    plan = build(engine="warp", devices=3)
    for resume in (False, True):
        _, *words = planning.train_words(plan, Row("full", 0), tmp_path, resume)
        options, _ = tyro.cli(train.Options, args=words, return_unknown_args=True)
        assert (options.engine, options.devices) == ("warp", 3)


def test_a_plan_goes_on_with_other_devices_and_one_of_before_engines_is_read(tmp_path):
    planning.claim(tmp_path, build(engine="warp", devices=3))
    planning.check(tmp_path, build(engine="warp"))
    with pytest.raises(ConfigError, match="engine warp, not auto; choose another --out"):
        planning.check(tmp_path, build())
    record = json.loads((tmp_path / "plan.json").read_text())
    del record["engine"]
    (tmp_path / "plan.json").write_text(json.dumps(record))
    planning.check(tmp_path, build())


def test_all_commands_of_a_plan_for_the_cpu_are_kept_from_a_gpu():
    assert planning.environment(build()) == {"JAX_PLATFORMS": "cpu"}
    assert planning.environment(build(samples=None, device="gpu")) == {}


def test_eval_takes_the_words_that_it_is_given(tmp_path):
    command, *words = progress.eval_words(build(), Row("full", 4), tmp_path, "gate")
    o = tyro.cli(eval.Options, args=words)
    assert (command, o.run, o.suite) == ("eval", (tmp_path / "full-seed4",), "gate")
    assert (o.num_envs, o.films) == (10, 0)
    assert o.out == tmp_path / "full-seed4" / "evaluation" / "gate"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"trials": 20}, "trials 10, not 20; choose another --out"),
        ({"trials": 9, "samples": 10e6}, "trials 10, not 9; choose another --out"),
        ({"seeds": (0,)}, "seeds 0 4, not 0"),
        ({"variants": ("full",)}, "variants full hpl, not full"),
        ({"samples": 10e6}, "configs.full.run.iterations 3256, not 1628"),
        ({"settings": MORE}, "settings none, not --run.chunk 1 --ppo.epochs 3"),
    ],
)
def test_another_plan_in_the_same_folder_is_refused_and_says_what_differs(tmp_path, change, says):
    planning.claim(tmp_path, build())
    planning.claim(tmp_path, build())
    with pytest.raises(ConfigError, match=f"holds another plan: .*{says}") as error:
        planning.claim(tmp_path, build(**change))
    assert "\n" not in str(error.value)
    planning.check(tmp_path / "elsewhere", build(**change))


def test_an_experiment_that_has_changed_between_two_starts_is_another_plan(tmp_path):
    planning.claim(tmp_path, build())
    path = tmp_path / "plan.json"
    record = json.loads(path.read_text())
    record["configs"]["hpl"]["ppo"]["gamma"] = 0.5
    path.write_text(json.dumps(record))
    with pytest.raises(ConfigError, match=r"configs.hpl.ppo.gamma 0.5, not 0.99; choose"):
        planning.claim(tmp_path, build())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"seeds": (1, 1)}, "--seeds must name one or more, each once"),
        ({"variants": ()}, "--variants must name one or more, each once"),
        ({"seeds": tuple(range(11))}, "--seeds must be at most 10, not 11"),
        (
            {"settings": ("--network.variant", "full")},
            "--settings: network.variant is each row's own; use --variants",
        ),
        ({"num_envs": 6}, "6 robots do not split into 4 minibatches"),
        ({"samples": 1.0}, "--distillation.teacher-iterations must be below"),
    ],
)
def test_a_plan_that_cannot_run_is_refused(change, says):
    with pytest.raises(ConfigError, match=says):
        build(**change)
