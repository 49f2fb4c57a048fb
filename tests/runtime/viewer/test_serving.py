"""Who may connect to what idesplat view serves, and where it is served."""

import http.client
import http.server
import shutil
import signal
import socket
import subprocess
import sys
import threading
from urllib.parse import urlsplit

import numpy as np
import pytest
from conftest import DEFAULT_SIGNALS, run_command
from idesplat.runtime.cli.view import main
from idesplat.runtime.splats.formats.ply import write_ply
from idesplat.runtime.splats.gaussians import with_colours
from idesplat.runtime.viewer.server import address, free_port, is_own_page, only_own_page

HANDSHAKE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Version": "13",
}
# Tries to connect as a page, and says whether it did and received a message, which a busy machine may send late.
CONNECT = """
([url, protocol]) => new Promise(resolve => {
  let opened = false
  const socket = new WebSocket(url, protocol)
  socket.onopen = () => { opened = true; setTimeout(() => resolve([opened, false]), 60000) }
  socket.onmessage = () => resolve([opened, true])
  socket.onerror = () => resolve([opened, false])
})
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("served") / "scene.ply"
    rng = np.random.default_rng(0)
    means, quats = rng.normal(size=(50, 3)), np.tile([1.0, 0, 0, 0], (50, 1))
    write_ply(path, with_colours(means, np.full((50, 3), 0.1), quats, np.full(50, 0.8), rng.random((50, 3))))
    return path


@pytest.fixture(scope="module")
def served(scene):
    """Runs the command with these arguments; the address that it prints, and its process."""
    processes = []

    def serve(*arguments):
        command = [sys.executable, "-P", "-c", "from idesplat.runtime.cli.view import main; main()", str(scene)]
        command += ["--no-browser", *map(str, arguments)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        processes.append(subprocess.Popen(command, **pipes, preexec_fn=DEFAULT_SIGNALS))
        line = processes[-1].stdout.readline()
        return next(word for word in line.split() if word.startswith("http://")), processes[-1]

    yield serve
    for process in processes:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def own(served):
    return served("--port", 0)[0]


def ask(page: str, **headers: str | None) -> int:
    """The status of a request for the page, or for its WebSocket, with these headers."""
    place = urlsplit(page)
    connection = http.client.HTTPConnection(place.hostname, place.port, timeout=30)
    connection.putrequest("GET", "/", skip_host=True)
    for name, value in {"Host": place.netloc, **headers}.items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders()
    status = connection.getresponse().status
    connection.close()
    return status


def test_own_page_is_answered(own):
    port = urlsplit(own).port
    assert ask(own) == 200
    assert ask(own, Host=f"localhost:{port}") == 200
    assert ask(own, Origin=own, **HANDSHAKE) == 101
    assert ask(own, Host="localhost:9000", Origin="http://localhost:9000", **HANDSHAKE) == 101  # through a tunnel


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://example.com"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "http://localhost"},
        {},
        {"Host": "rebound.example.com", "Origin": "http://rebound.example.com"},
        {"Host": "127.0.0.1.example.com"},
        {"Host": None},
    ],
    ids=str,
)
def test_other_pages_are_refused(own, headers):
    assert ask(own, **headers, **HANDSHAKE) in (400, 403)
    if headers:
        assert ask(own, **headers) in (400, 403)


def test_pages_of_other_origins_in_a_browser(own, browser, served):
    """A page of another port of this machine, and one whose name leads here, receive nothing; the own page does."""
    import viser

    protocol = f"viser-v{viser.__version__}"
    handler = http.server.SimpleHTTPRequestHandler
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as elsewhere:
        threading.Thread(target=elsewhere.serve_forever, daemon=True).start()
        socket_address = own.replace("http://", "ws://")
        found = {}
        for name, page in {"other": f"http://127.0.0.1:{elsewhere.server_port}/", "own": own}.items():
            context = browser.new_context()
            tab = context.new_page()
            tab.goto(page)
            found[name] = tab.evaluate(CONNECT, [socket_address, protocol])
            context.close()
        elsewhere.shutdown()
    assert found == {"other": [False, False], "own": [True, True]}


def test_a_name_that_leads_here_in_a_browser(own, browser):
    """DNS rebinding: the browser takes the page of that name and the server for the same origin."""
    import viser

    port = urlsplit(own).port
    flags = ["--no-sandbox", "--host-resolver-rules=MAP rebound.example.com 127.0.0.1"]
    path = shutil.which("chromium") or shutil.which("google-chrome")
    with browser.browser_type.launch(executable_path=path, args=flags) as rebound:
        tab = rebound.new_page()
        assert tab.goto(f"http://rebound.example.com:{port}/").status == 403
        connect = [f"ws://rebound.example.com:{port}", f"viser-v{viser.__version__}"]
        assert tab.evaluate(CONNECT, connect) == [False, False]


def test_a_busy_port_means_the_next(served, scene):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        page, _ = served("--port", port)
        assert urlsplit(page).port > port
        assert ask(page) == 200


@pytest.mark.parametrize("host, words", [("", "--host is empty"), ("203.0.113.1", "cannot serve at 203.0.113.1")])
def test_hosts_that_are_refused(scene, host, words, capsys):
    assert run_command(main, scene, "--host", host, "--no-browser") == 2
    assert words in capsys.readouterr().err


def test_no_port_is_left():
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.bind(("127.0.0.1", 65535))
        taken.listen(1)
        with pytest.raises(ValueError, match="ports 65535 to 65535 are in use"):
            free_port("127.0.0.1", 65535)


def test_addresses():
    assert address("127.0.0.1", 80) == "http://127.0.0.1:80"
    assert address("0.0.0.0", 81) == "http://127.0.0.1:81"
    assert address("::1", 82) == "http://[::1]:82"


def test_names_of_this_machine():
    assert is_own_page("127.0.0.1", "[::1]:8080", None)
    assert is_own_page("0.0.0.0", f"{socket.gethostname()}:8080", None)
    assert is_own_page("box.lan", "BOX.lan:8080", "http://box.lan:8080")
    assert not is_own_page("127.0.0.1", "box.lan:8080", None)
    assert not is_own_page("0.0.0.0", "example.com:8080", "http://example.com:8080")
    assert not is_own_page("127.0.0.1", "[:8080", None)
    assert not is_own_page("127.0.0.1", "127.0.0.1:8080", "https://127.0.0.1:8080")


def test_a_server_that_cannot_be_guarded_is_not_used():
    with pytest.raises(RuntimeError, match="not protected"), only_own_page("127.0.0.1"):
        pass


@pytest.mark.slow
@pytest.mark.posix
@pytest.mark.parametrize("number, status", [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_signals_end_it(served, number, status):
    _, process = served("--port", 0)
    process.send_signal(number)
    printed = process.communicate(timeout=60)
    assert process.returncode == status
    assert printed == ("", "")
