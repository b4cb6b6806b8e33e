"""Logging to Weights & Biases, with a package that is made up or not there at all."""

import sys
import types

import pytest

from cref_jax.errors import ConfigError
from cref_jax.training import wandb_log
from cref_jax.training.wandb_log import WandbLog

KEYS = ("WANDB_MODE", "WANDB_API_KEY", "WANDB_PROJECT")
URL = "https://api.wandb.ai"


class FakeRun:
    """A run that remembers what it is told, and raises where it is asked to."""

    def __init__(self, id, fails):
        self.id, self.url, self.rows, self.finished, self.fails = id, "its page", {}, 0, fails

    def log(self, row, step):
        if "log" in self.fails:
            raise ConnectionError("the network\nis gone")
        self.rows[step] = row

    def finish(self):
        self.finished += 1
        if "finish" in self.fails:
            raise TimeoutError("too late")


class FakeWandb(types.ModuleType):
    """The package's documented calls: init and Settings."""

    def __init__(self, fails):
        super().__init__("wandb")
        self.fails, self.runs, self.asked = fails, [], []

    def Settings(self, **options):
        return types.SimpleNamespace(base_url=URL, **options)

    def init(self, **options):
        if "init" in self.fails:
            raise OSError(28, "No space left on device")
        self.asked.append(options)
        self.runs.append(FakeRun(options["id"] or f"id{len(self.runs)}", self.fails))
        return self.runs[-1]


@pytest.fixture
def package(monkeypatch, tmp_path):
    """Return a function that installs the package that raises in these calls."""
    for key in KEYS:
        monkeypatch.delenv(key, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))

    def install(*fails):
        module = FakeWandb(fails)
        monkeypatch.setitem(sys.modules, "wandb", module)
        return module

    return install


def test_every_iteration_is_logged_and_a_resumed_run_goes_on_under_its_id(package, tmp_path):
    wandb, run, said = package(), tmp_path / "flat-1", []
    run.mkdir()
    for first in (0, 2):
        log = WandbLog(run, {"seed": 7}, said.append)
        log.log({"loss/kl": 0.5}, first + 1)
        log.log({"loss/kl": 0.25}, first + 2)
        log.close()
    begun, resumed = wandb.asked
    assert (begun["id"], begun["mode"], begun["resume"]) == (None, "offline", "allow")
    assert (begun["name"], begun["config"], begun["dir"]) == ("flat-1", {"seed": 7}, str(run))
    assert resumed["id"] == "id0" and (run / "wandb_id").read_text() == "id0\n"
    assert [one.rows for one in wandb.runs] == [
        {1: {"loss/kl": 0.5}, 2: {"loss/kl": 0.25}},
        {3: {"loss/kl": 0.5}, 4: {"loss/kl": 0.25}},
    ]
    assert [one.finished for one in wandb.runs] == [1, 1]
    assert said == [f"wandb: offline, in {run / 'wandb'}; `wandb sync` sends it"] * 2


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        ("init", "OSError: [Errno 28] No space left on device"),
        ("log", "ConnectionError: the network is gone"),
        ("finish", "TimeoutError: too late"),
    ],
)
def test_whatever_fails_there_is_one_line_and_training_goes_on(package, tmp_path, call, reason):
    wandb, said = package(call), []
    log = WandbLog(tmp_path, {}, said.append)
    for iteration in (1, 2, 3):
        log.log({"loss/kl": 0.5}, iteration)
    log.close()
    warnings = [line for line in said if line.startswith("warning")]
    assert warnings == [f"warning: no more is logged to wandb: {reason}"]
    assert all(one.rows == {} for one in wandb.runs) or call == "finish"


def test_a_package_that_raises_everywhere_is_one_line(package, tmp_path):
    package("init", "log", "finish")
    said = []
    log = WandbLog(tmp_path, {}, said.append)
    log.log({}, 1)
    log.close()
    assert len(said) == 1 and not (tmp_path / "wandb_id").exists()


def test_it_is_online_where_there_is_a_key_and_the_users_word_goes_first(
    package, tmp_path, monkeypatch
):
    assert wandb_log.choose_mode(URL) == "offline"
    (tmp_path / "netrc").write_text("machine elsewhere.test login user password x\n")
    assert wandb_log.choose_mode(URL) == "offline"
    assert wandb_log.choose_mode("https://elsewhere.test/api") == "online"
    (tmp_path / "netrc").write_text("machine api.wandb.ai login user password x\n")
    assert wandb_log.choose_mode(URL) == "online"
    monkeypatch.setenv("WANDB_MODE", "disabled")
    assert wandb_log.choose_mode(URL) == "disabled"
    monkeypatch.delenv("WANDB_MODE")
    monkeypatch.setenv("WANDB_API_KEY", "x")
    (tmp_path / "netrc").unlink()
    assert wandb_log.choose_mode(URL) == "online"


def test_a_missing_package_is_an_error_that_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ConfigError, match=r"pip install 'cref-jax\[wandb\]'"):
        wandb_log.check_installed()


def test_a_broken_package_is_left_to_the_first_call(package):
    package()
    wandb_log.check_installed()
