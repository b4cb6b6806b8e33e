import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import pytest

from cref_jax.errors import ConfigError
from cref_jax.live import drive_panel, server
from cref_jax.live.server import Settings
from cref_jax.live.session import Wish
from cref_jax.live.stage import Place
from cref_jax.live.training_panel import TrainingPanel

CURBS = Settings(Path("robust"), Place(scene="curbs"))


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def page():
    port = free_port()
    page = server.open_page(CURBS, port)
    page._draw(0)  # the robot is there before the thread and a test draw it
    thread = threading.Thread(target=page.run)
    thread.start()
    yield page, port, thread
    page.stop()
    thread.join()
    page.close()


def test_the_page_answers_on_this_machine(page):
    with urllib.request.urlopen(f"http://127.0.0.1:{page[1]}/", timeout=30) as answer:
        assert answer.status == 200
        assert b"<!doctype html>" in answer.read(200)


def test_it_goes_on_drawing(page):
    time.sleep(0.5)  # a dozen frames
    page[0]._draw(1)
    assert page[2].is_alive() and page[0].clock.failure is None
    assert page[0].clock.share > 0.0


def test_another_scene_and_policy_are_taken_without_a_restart(page):
    choice, session = page[0]._choice, page[0]._session
    choice._kind.value, choice._scene.value = "scene", "planks"
    choice._go_there()
    choice._take("mixed")
    view = session.view()
    assert (view.stage.place.scene, view.stage.policy.name) == ("planks", "mixed")
    page[0]._draw(0)


@pytest.mark.parametrize(
    ("source", "message"), [("mixd", "no run or policy mixd"), ("pyproject.toml", "pyproject.toml")]
)
def test_a_policy_that_there_is_not_is_said_and_the_robot_walks_on(
    page, monkeypatch, source, message
):
    said, before = [], page[0]._session.view().stage
    monkeypatch.setattr(page[0]._choice, "complain", said.append)
    page[0]._choice._take(source)
    assert len(said) == 1 and message in said[0] and "\n" not in said[0]
    assert page[0]._session.view().stage is before


def test_keys_change_what_is_asked_within_its_limits(page):
    """From 0.9 m/s, four presses of 0.05 end at the limit of 1 m/s; turning leaves the lane."""
    drive, session = page[0]._drive, page[0]._session
    session.drive(Wish(vx=0.9))
    for _ in range(4):
        drive._change(drive_panel.FORWARD_STEP, 0.0)
    assert session.wish == Wish(vx=1.0)
    drive._change(0.0, drive_panel.TURN_STEP)
    assert session.wish == Wish(vx=1.0, yaw_rate=0.1, keep_lane=False)
    drive.refresh()
    assert (drive._forward.value, drive._turn.value, drive._lane.value) == (1.0, 0.1, False)


def test_a_key_that_is_held_delays_no_other_key(page, monkeypatch):
    """Two keys are held, and repeated every 30 ms: each acts at 0, 90 and 180 ms."""
    drive, said = page[0]._drive, []
    for k in range(7):
        monkeypatch.setattr(drive_panel, "time", SimpleNamespace(perf_counter=lambda k=k: 0.03 * k))
        for key in ("held", "other"):
            drive._press(key, lambda key=key, k=k: said.append((30 * k, key)))
    assert said == [(at, key) for at in (0, 90, 180) for key in ("held", "other")]


def test_a_checkpoint_waits_while_another_policy_walks(page):
    session, policy = page[0]._session, page[0]._session.view().stage.policy
    panel = TrainingPanel(page[0]._sight.panel, page[0]._server, session, Path("runs/none"))
    assert not panel._offer(policy._replace(name="runs/none", detail="iteration 3"))
    assert panel._said.content == "iteration 3 is there, but another policy walks"
    assert panel._offer(policy._replace(detail="iteration 4"))
    assert panel._said.content == "iteration 4 walks from the next start on"


def test_it_is_not_to_be_reached_from_elsewhere(page):
    """127.0.0.2 is this machine, too, but not the address that is listened on."""
    with pytest.raises(OSError), socket.create_connection(("127.0.0.2", page[1]), timeout=5):
        pass


def test_a_taken_port_gives_the_next_free_one():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < server.find_port("127.0.0.1", port) < port + server.PORTS


@pytest.mark.parametrize(
    ("host", "port", "message"),
    [
        ("203.0.113.1", 8080, "--host 203.0.113.1: "),
        ("no such host", 8080, "--host no such host: "),
    ],
)
def test_an_address_that_cannot_be_used_is_one_line(host, port, message):
    with pytest.raises(ConfigError, match=message):
        server.find_port(host, port)


def test_it_says_how_to_reach_it_from_another_machine(monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "box")
    said = server.describe_address("127.0.0.1", 8081)
    assert "http://127.0.0.1:8081" in said
    assert "ssh -L 8081:127.0.0.1:8081 box" in said


@pytest.mark.slow
@pytest.mark.parametrize(("desktop", "opened"), [("DISPLAY", ["http://127.0.0.1:8099"]), ("X", [])])
def test_the_browser_opens_where_there_is_a_desktop(monkeypatch, desktop, opened):
    """Without one a text browser would take the terminal."""
    asked = []
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(desktop, ":0")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(server.webbrowser, "open", asked.append)
    monkeypatch.setattr(server, "find_port", lambda host, port: port)
    monkeypatch.setattr(server, "open_page", lambda settings, port: SimpleNamespace(run=list))
    server.serve(Settings(Path("robust"), Place("flat", 0.0), port=8099, opens_browser=True))
    assert asked == opened


def test_ctrl_c_ends_it_quietly():
    words = f"-m cref_jax.play --live --policy robust --scene curbs --port {free_port()}"
    command = [sys.executable, *words.split()]
    heed = lambda: signal.signal(signal.SIGINT, signal.default_int_handler)  # not so behind nohup
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed
    ) as live:
        assert live.stdout
        assert live.stdout.readline().startswith("open http://127.0.0.1:")
        live.send_signal(signal.SIGINT)
        said, complaints = live.communicate(timeout=60)
    assert live.returncode == 130
    assert complaints.split() == ["interrupted"]
    assert "Traceback" not in said
