"""A service without a token and with a limit on memory, how it stops, and when it does not start."""

import signal
import socket
import subprocess
import sys

import pytest
from conftest import run_command
from idesplat.runtime.cli.serve import main
from mutations import EXAMPLES, TEXTS
from running_service import running_service, wait_for
from tiny_model import write_model

pytestmark = pytest.mark.slow

FAST = {"quality": "fast", "size": "64x96"}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return write_model(tmp_path_factory.mktemp("model") / "tiny.onnx")


def form(scene):
    files = [("images", (path.name, path.read_bytes())) for path in sorted((scene / "images").iterdir())[:3]]
    return [*files, ("cameras", ("transforms.json", (scene / "transforms.json").read_bytes()))]


@pytest.mark.posix
def test_a_service_that_stops_finishes_what_runs_and_answers_what_waits(model, scene, tmp_path):
    # Compiling the refinement, where it was not compiled before, takes more than one gigabyte.
    options = ("--model", model, "--max-memory", 2, "--max-size", "8192x8192")
    with running_service(tmp_path, *options) as service, service.client() as client:
        other = {"Origin": "http://example.org"}
        assert client.get("/metrics", headers=other).status_code == 403
        assert client.post("/v1/scenes", files=form(scene), headers=other).status_code == 403
        assert client.get("/metrics", headers={"Host": "rebound.example.org"}).status_code == 403

        if sys.platform == "linux":
            huge = client.post("/v1/scenes", files=form(scene), data=FAST | {"size": "8192x8192"}).json()
            found = wait_for(client, huge["id"])
            assert found["state"] == "failed"
            assert "memory" in found["error"] and "/" not in found["error"]

        running = client.post("/v1/scenes", files=form(scene), data=FAST | {"views": 3, "refine": "1s"}).json()
        queued = client.post("/v1/scenes", files=form(scene), data=FAST).json()
        wait_for(client, running["id"], ("running",))
        service.process.send_signal(signal.SIGTERM)
        found = wait_for(client, queued["id"])
        assert (found["state"], "stopped" in found["error"]) == ("failed", True)
        assert client.post("/v1/scenes", files=form(scene), data=FAST).status_code == 503
        assert client.get("/ready").status_code == 503
        assert client.get("/health").status_code == 200
        found = wait_for(client, running["id"])
        assert found["state"] == "done", found
        assert client.get(running["url"] + "/scene.ply").content.startswith(b"ply")
        assert service.process.wait(30) == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--host", "0.0.0.0"], "IDESPLAT_TOKEN"),
        (["--host", "192.0.2.1", "--token", "secret"], "cannot serve at 192.0.2.1"),
        (["--host", "no such host", "--token", "secret"], "cannot serve at no such host"),
        (["--token", "ünicode"], "--token"),
        (["--model", "missing.onnx"], "missing.onnx"),
        (["--max-size", "big"], "big"),
        (["--storage", "/dev/null/x"], "/dev/null/x"),
    ],
)
def test_a_service_that_cannot_start_says_why(options, message, monkeypatch, capsys):
    monkeypatch.delenv("IDESPLAT_TOKEN", raising=False)
    assert run_command(main, "--port", 0, *options) == 2
    printed = capsys.readouterr()
    assert (printed.out, printed.err.count("\n")) == ("", 1)
    assert printed.err.startswith("error: ")
    assert message in printed.err


def test_a_model_that_cannot_be_opened_ends_the_service(tmp_path):
    damaged = write_model(tmp_path / "damaged.onnx")
    damaged.write_bytes(damaged.read_bytes().replace(b"ReduceMean", b"ReduceNone"))
    command = [sys.executable, "-P", "-m", "idesplat", "serve", "--port", "0", "--model", damaged]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("error: ")
    assert "damaged.onnx" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("option", ["--host", "--token", "--max-size", "--storage", "--model", "--max-queue", "--keep"])
def test_odd_values_of_options_are_one_line(option, model, monkeypatch, capsys, tmp_path):
    """At a port that is in use, so that no service starts."""
    monkeypatch.delenv("IDESPLAT_TOKEN", raising=False)
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = busy.getsockname()[1]
        for text in TEXTS if EXAMPLES else TEXTS[::5]:
            assert run_command(main, "--port", port, "--model", model, f"{option}={text}") == 2, text
            printed = capsys.readouterr()
            assert (printed.out, printed.err.count("\n")) == ("", 1), text
            assert printed.err.startswith("error: "), text
    assert list(tmp_path.iterdir()) == []
