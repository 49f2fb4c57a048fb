"""A real service over HTTP: whole jobs, failures of workers, limits, and requests that nobody should send."""

import http.client
import io
import json
import os
import re
import signal
import socket
import struct
import subprocess
import threading
import time
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from idesplat.runtime.reconstruction.pipeline import reconstruct
from idesplat.runtime.service.fields import FIELDS
from idesplat.runtime.splats.io import read_splats
from mutations import TEXTS, Content, mutated, tried
from prometheus_client.parser import text_string_to_metric_families
from running_service import running_service, wait_for
from tiny_model import write_model

pytestmark = pytest.mark.slow

TOKEN = "the token of these tests"
LIMITS = ("--max-queue", 3, "--max-upload", 2, "--max-megapixels", 4, "--max-images", 6, "--max-views", 4)
FAST = {"quality": "fast", "size": "64x96"}
ENDLESS = {**FAST, "views": "3", "refine": "500s"}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return write_model(tmp_path_factory.mktemp("model") / "tiny.onnx")


@pytest.fixture(scope="module")
def service(model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("storage")
    with running_service(folder, "--model", model, *LIMITS, token=TOKEN) as running:
        yield running


@pytest.fixture(scope="module")
def slow_senders(service):
    """Answers to clients that send a byte a second for ever; they come while the other tests run."""
    head = f"POST /v1/scenes HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {TOKEN}\r\n"
    form = "Content-Type: multipart/form-data; boundary=b\r\nContent-Length: 100000\r\n\r\n"
    answers: dict[str, bytes] = {}

    def trickle(name: str, start: str, pause: float) -> None:
        port = int(service.url.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port)) as connection:
            connection.sendall(start.encode())
            connection.settimeout(pause)
            while True:
                try:
                    answers[name] = connection.recv(4096)
                    return
                except TimeoutError:
                    connection.sendall(b"a")

    cases = {"headers": (head + "X-Slow: ", 0.5), "body": (head + form + "--b\r\n", 60)}
    threads = [threading.Thread(target=trickle, args=(name, *case)) for name, case in cases.items()]
    for thread in threads:
        thread.start()
    return threads, answers


@pytest.fixture
def client(service, slow_senders):
    with service.client(TOKEN) as client:
        yield client


@pytest.fixture
def parts(scene):
    """The files of a form: three images and their cameras."""
    return [*images_of(scene, 3), ("cameras", ("transforms.json", (scene / "transforms.json").read_bytes()))]


def images_of(scene, count):
    return [("images", (path.name, path.read_bytes())) for path in sorted((scene / "images").iterdir())[:count]]


def post(client, files, data=FAST):
    return client.post("/v1/scenes", files=files, data=data)


def zipped(entries, compression=zipfile.ZIP_DEFLATED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return [("images", ("scene.zip", buffer.getvalue()))]


def png(width, height, pixels=b""):
    """A PNG that states this size, whatever it holds."""

    def chunk(kind, content):
        return struct.pack(">L", len(content)) + kind + content + struct.pack(">L", zlib.crc32(kind + content))

    header = struct.pack(">LLBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")


def events(client, scene):
    """The states of a scene as its events tell them, until it has ended."""
    with client.stream("GET", f"/v1/scenes/{scene}/events") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        for line in answer.iter_lines():
            if line.startswith("data: "):
                yield json.loads(line.removeprefix("data: "))


def test_a_scene_from_upload_to_result(client, parts, scene, model, tmp_path):
    answer = post(client, parts)
    assert answer.status_code == 202, answer.text
    url = answer.headers["location"]
    told = list(events(client, answer.json()["id"]))
    assert told[-1]["state"] == "done"
    assert any(state["progress"] for state in told)
    assert client.get(url).json() == told[-1]
    expected = reconstruct(
        scene / "images", scene / "transforms.json", model=model, select="0-2", views=2, size=(64, 96)
    )
    assert told[-1]["views"] == expected.views.names
    for name in ("scene.ply", "scene.spz", "scene.points.ply"):
        result = client.get(f"{url}/{name}")
        assert result.status_code == 200, result.text
        (tmp_path / name).write_bytes(result.content)
    splats, packed = read_splats(tmp_path / "scene.ply"), read_splats(tmp_path / "scene.spz")
    np.testing.assert_array_equal(splats.means, expected.gaussians.means)
    np.testing.assert_allclose(packed.means, expected.gaussians.means, atol=1e-3)
    assert told[-1]["gaussians"] == len(splats)
    depth = np.load(io.BytesIO(client.get(f"{url}/depth/{expected.views.names[0][:-4]}.npz").content))
    np.testing.assert_array_equal(depth["depth"], expected.depth[0])
    summary = client.get(f"{url}/summary.json").json()
    assert summary["model"]["path"] == "tiny.onnx"
    assert set(summary["files"]) | {"summary.json"} == set(told[-1]["files"]) - {"scene.spz", "scene.points.ply"}
    cameras = client.get(f"{url}/cameras.json").json()["cameras"]
    assert {camera["image"] for camera in cameras} == {f"images/00{index}.png" for index in range(3)}
    assert client.get(f"{url}/scene.mesh.ply").status_code == 404


def test_a_zip_with_cameras(client, scene):
    entries = [(f"room/images/{path.name}", path.read_bytes()) for path in sorted((scene / "images").iterdir())]
    entries += [("room/transforms.json", (scene / "transforms.json").read_bytes()), ("room/notes.doc", b"not read")]
    answer = post(client, zipped(entries), FAST | {"select": "1,4", "render": "true"})
    assert answer.status_code == 202, answer.text
    found = wait_for(client, answer.json()["id"])
    assert found["state"] == "done", found["error"]
    assert found["views"] == ["001.png", "004.png"]
    assert "renders/view-001.png" in found["files"]
    assert client.get(f"{found['url']}/renders/view-001.png").content.startswith(b"\x89PNG")


def test_cameras_are_estimated_where_there_are_none(client, scene):
    images = images_of(scene, 5)
    answer = post(client, [images[0], images[4]], FAST | {"focal": "106.5"})
    found = wait_for(client, answer.json()["id"])
    assert found["state"] == "done", found["error"]
    names = [camera["image"] for camera in client.get(f"{found['url']}/cameras.json").json()["cameras"]]
    assert names == ["000.png", "004.png"]


def test_a_scene_that_cannot_be_reconstructed_says_why(client, scene):
    cameras = ("cameras", ("transforms.json", json.dumps({"frames": []}).encode()))
    found = wait_for(client, post(client, [*images_of(scene, 2), cameras]).json()["id"])
    assert found["state"] == "failed"
    assert found["error"].startswith("cameras/transforms.json: ")
    answer = client.get(f"{found['url']}/scene.ply")
    assert answer.status_code == 409
    assert found["error"] in answer.json()["detail"]


def test_a_camera_file_does_not_tell_of_other_files(client, scene):
    """Sizes that cameras lack are those of the images that they name, but not of images that were not sent."""
    content = json.loads((scene / "transforms.json").read_text())
    shared = {name: content.pop(name) for name in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    for frame in content["frames"]:
        frame |= {"fl_x": shared["fl_x"]}
    errors = []
    for other in (scene / "images" / "004.png", scene / "images" / "404.png"):
        content["frames"] = [*content["frames"][:2], content["frames"][2] | {"file_path": str(other)}]
        cameras = ("cameras", ("transforms.json", json.dumps(content).encode()))
        found = wait_for(client, post(client, [*images_of(scene, 2), cameras]).json()["id"])
        assert found["state"] == "failed", found
        errors.append(found["error"].replace(str(other), "..."))
    assert errors[0] == errors[1]


@pytest.mark.posix
def test_a_worker_that_is_killed_fails_one_scene(client, service, parts):
    scene = post(client, parts, ENDLESS).json()["id"]
    waiting = post(client, parts).json()["id"]
    wait_for(client, scene, ("running",))
    for line in subprocess.run(
        ["pgrep", "-P", str(service.process.pid)], capture_output=True, text=True
    ).stdout.split():
        os.kill(int(line), signal.SIGKILL)
    found = wait_for(client, scene)
    assert found["state"] == "failed"
    assert "was killed" in found["error"]
    assert wait_for(client, waiting)["state"] == "done"


def test_cancelled_scenes_end(client, parts):
    running, queued = (post(client, parts, ENDLESS).json() for _ in range(2))
    wait_for(client, running["id"], ("running",))
    assert client.get(queued["url"]).json()["position"] == 0
    for scene in (queued, running):
        assert client.delete(scene["url"]).status_code == 204
        found = wait_for(client, scene["id"])
        assert (found["state"], found["files"]) == ("cancelled", [])
        assert client.delete(scene["url"]).status_code == 204
        assert client.get(scene["url"]).status_code == 404


def test_overload_is_answered_with_429(client, parts):
    urls = []
    while (answer := post(client, parts, ENDLESS)).status_code == 202:
        urls.append(answer.headers["location"])
        wait_for(client, answer.json()["id"], ("running",) if len(urls) == 1 else ("queued",))
    assert 3 <= len(urls) <= 4  # one of the slow senders may have a place in the queue
    assert answer.status_code == 429
    assert 1 <= int(answer.headers["retry-after"]) <= 60
    for url in reversed(urls):
        client.delete(url)
    wait_for(client, urls[0].rpartition("/")[2])
    answer = post(client, parts)
    assert wait_for(client, answer.json()["id"])["state"] == "done"


@pytest.mark.parametrize("headers", [{}, {"Authorization": "Bearer wrong"}, {"Authorization": TOKEN}])
def test_without_the_token_nothing_but_the_probes_is_answered(service, parts, headers):
    with service.client() as client:
        client.headers.update(headers)
        for path in ("/health", "/ready", "/", "/page/main.js"):
            assert client.get(path).status_code == 200
        for path in ("/metrics", "/v1/scenes/0", "/v1/scenes/0/scene.ply", "//v1/scenes/0", "/nothing"):
            answer = client.get(path)
            assert answer.status_code == 401
            assert answer.headers["www-authenticate"] == "Bearer"
        assert post(client, parts).status_code == 401


IMAGE = png(64, 48, bytes(48 * (1 + 64 * 3)))
TWO = [("images", ("a.png", IMAGE)), ("images", ("b.png", IMAGE))]
ENTRIES = [("a.png", IMAGE), ("b.png", IMAGE)]
STORED = zipped(ENTRIES, zipfile.ZIP_STORED)[0][1][1]


def link_entry():
    entry = zipfile.ZipInfo("c.png")
    entry.external_attr = 0o120777 << 16
    return [*ENTRIES, (entry, "/etc/passwd")]


def many_entries():
    """A zip that claims to list 256 MiB of entries."""
    ((field, (name, content)),) = zipped(ENTRIES)
    at = content.rindex(b"PK\x05\x06")
    return [(field, (name, content[: at + 12] + struct.pack("<L", 1 << 28) + content[at + 16 :]))]


# A name that no other test writes: nothing of it may appear on the disk.
ESCAPED = "leads-out-of-the-zip.png"

HOSTILE = {
    "no multipart": (None, {}, 415),
    "one image": (TWO[:1], {}, 422),
    "no images": ([("cameras", ("transforms.json", b"{}"))], {}, 422),
    "not an image": ([*TWO, ("images", ("c.png", b"MZ" * 100))], {}, 422),
    "another type": ([*TWO, ("images", ("c.exe", IMAGE))], {}, 415),
    "a script as cameras": ([*TWO, ("cameras", ("cameras.py", b"exit()"))], {}, 415),
    "an unknown file": ([*TWO, ("model", ("model.onnx", IMAGE))], {}, 422),
    "too many images": ([("images", (f"{index}.png", IMAGE)) for index in range(7)], {}, 413),
    "one name twice": ([*TWO, ("images", ("A.PNG", IMAGE))], {}, 422),
    "a hidden file": ([*TWO, ("images", (".png", IMAGE))], {}, 415),
    "control characters": ([*TWO, ("images", ("a\x1b[2J.png", IMAGE))], {}, 422),
    "a long name": ([*TWO, ("images", ("a" * 300 + ".png", IMAGE))], {}, 422),
    "too many bytes": ([*TWO, ("images", ("c.png", bytes(3 << 20)))], {}, 413),
    "too many pixels": ([*TWO, ("images", ("c.png", png(2500, 2500)))], {}, 413),
    "a bomb of pixels": ([*TWO, ("images", ("c.png", png(60000, 60000, bytes(1000))))], {}, 413),
    "negative pixels": ([*TWO, ("images", ("c.png", png(0, 0)))], {}, 422),
    "zip that leads out": (zipped([*ENTRIES, (f"../../../{ESCAPED}", IMAGE)]), {}, 422),
    "zip with an absolute name": (zipped([*ENTRIES, (f"/tmp/{ESCAPED}", IMAGE)]), {}, 422),
    "zip with a backslash": (zipped([*ENTRIES, (f"..\\{ESCAPED}", IMAGE)]), {}, 422),
    "zip with a drive": (zipped([*ENTRIES, (f"C:{ESCAPED}", IMAGE)]), {}, 422),
    "zip with a link": (zipped(link_entry()), {}, 422),
    "zip bomb": (zipped([*ENTRIES, ("c.png", bytes(64 << 20))]), {}, 413),
    "zip of many": (zipped([(f"{index}.png", b"") for index in range(1100)]), {}, 413),
    "zip with a huge list": (many_entries(), {}, 413),
    "zip that is cut": ([("images", ("a.zip", zipped(ENTRIES)[0][1][1][:-30]))], {}, 422),
    "zip that is damaged": ([("images", ("a.zip", STORED.replace(b"IDAT", b"JUNK")))], {}, 422),
    "zip without images": (zipped([("a.txt", b"text")]), {}, 422),
    "an unknown field": (TWO, {"model": "/etc/passwd"}, 422),
    "a wrong type": (TWO, {"near": "close"}, 422),
    "no number": (TWO, {"far": "nan"}, 422),
    "a negative depth": (TWO, {"near": "-1"}, 422),
    "near behind far": (TWO, {"near": "5", "far": "2"}, 422),
    "an unknown quality": (TWO, {"quality": "best"}, 422),
    "a share beyond 1": (TWO, {"min_opacity": "7"}, 422),
    "a long value": (TWO, {"select": "0," * 2000}, 422),
    "a large field": (TWO, {"select": "0," * 4000}, 400),
    "many fields": (TWO, {f"field{index}": "1" for index in range(100)}, 400),
    "steps without end": (TWO, {"refine": "1" * 30}, 422),
    "many views": ([("images", (f"{index}.png", IMAGE)) for index in range(5)], {"views": "all"}, 413),
    "a large size": (TWO, {"size": "8192x8192"}, 413),
    "a size without end": (TWO, {"size": f"{10**30}x1"}, 422),
    "cameras as text": (TWO, {"cameras": "/etc/passwd"}, 422),
    "no boolean": (TWO, {"render": "perhaps"}, 422),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_is_not_taken_leaves_nothing_behind(client, service, case):
    files, data, status = HOSTILE[case]
    before = service.jobs()
    answer = client.post("/v1/scenes", files=files, data=data, content=None if files else b"text")
    assert answer.status_code == status, answer.text
    if status != 400:
        assert 10 < len(answer.json()["detail"]) < 1000
        assert str(service.storage) not in answer.text
    assert service.jobs() <= before
    assert not list(service.storage.parent.rglob(f"*{ESCAPED}"))
    assert not Path("/tmp", ESCAPED).exists()


def status_of(client, path):
    """The status of the answer to a path that is sent as it is: httpx would leave out what leads upwards."""
    connection = http.client.HTTPConnection(client.base_url.host, client.base_url.port, timeout=60)
    connection.request("GET", path, headers={"Authorization": f"Bearer {TOKEN}"})
    try:
        return connection.getresponse().status
    finally:
        connection.close()


@pytest.mark.parametrize(
    "path",
    ["/v1/scenes/../../etc/passwd", "/v1/scenes/%2e%2e%2f%2e%2e", "/v1/scenes/" + "a" * 5000, "/v1/scenes/%00", "/%ff"],
)
def test_ids_lead_nowhere_else(client, path):
    assert status_of(client, path) == 404


def test_names_of_results_lead_nowhere_else(client, service, parts):
    url = wait_for(client, post(client, parts).json()["id"])["url"]
    for name in ("../scene.ply", "depth/../summary.json", "depth/%2e%2e%2fscene.ply", "scene./../../x", "out", "depth"):
        assert status_of(client, f"{url}/{name}") == 404, name


@pytest.mark.parametrize(
    ("request_bytes", "statuses"),
    [
        (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"a" * 100_000 + b"\r\n\r\n", {b"400", b"431"}),
        (b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 10_000 + b"\r\n", {b"400", b"431"}),
        (b"\x16\x03\x01\x02\x00 not HTTP\r\n\r\n", {b"400"}),
        (b"POST /v1/scenes HTTP/1.1\r\nHost: a\r\nContent-Length: -5\r\n\r\n", {b"400"}),
        (
            b"POST /v1/scenes HTTP/1.1\r\nHost: a\r\nContent-Length: 99999999999999999999\r\n\r\n",
            {b"400", b"401", b"413"},
        ),
    ],
    ids=["a huge header", "many headers", "another protocol", "a negative length", "an absurd length"],
)
def test_invalid_requests_are_refused(service, client, request_bytes, statuses):
    with socket.create_connection(("127.0.0.1", int(service.url.rpartition(":")[2])), timeout=20) as connection:
        connection.sendall(request_bytes)
        assert connection.recv(4096).split()[1] in statuses


def test_an_upload_that_breaks_off_leaves_nothing_behind(service, client):
    before = service.jobs()
    head = f"POST /v1/scenes HTTP/1.1\r\nHost: a\r\nAuthorization: Bearer {TOKEN}\r\n"
    form = "Content-Type: multipart/form-data; boundary=b\r\nContent-Length: 100000\r\n\r\n--b\r\n"
    with socket.create_connection(("127.0.0.1", int(service.url.rpartition(":")[2]))) as connection:
        connection.sendall((head + form).encode())
        ends = time.monotonic() + 20
        while not service.jobs() - before and time.monotonic() < ends:
            time.sleep(0.01)
        assert len(service.jobs() - before) == 1
    ends = time.monotonic() + 20
    while service.jobs() - before and time.monotonic() < ends:
        time.sleep(0.05)
    assert service.jobs() <= before


@tried(20)
@given(data=st.data())
def test_any_request_is_answered(service, scene, data):
    """Forms with damaged bytes, and whatever values their fields have, are taken or refused, and never an error."""
    kind = {"Content-Type": "multipart/form-data; boundary=0123456789abcdef"}
    names = data.draw(st.lists(st.sampled_from([*FIELDS]), max_size=3))
    fields = {name: data.draw(st.sampled_from(TEXTS)).encode("utf-8", "replace") for name in names}
    files = [*images_of(scene, 2), ("cameras", ("transforms.json", (scene / "transforms.json").read_bytes()))]
    with service.client(TOKEN) as client:
        whole = Content(client.build_request("POST", "/", files=files, data=FAST | fields, headers=kind).read())
        content = data.draw(mutated(whole)) if data.draw(st.booleans()) else whole
        answer = client.post("/v1/scenes", content=content, headers=kind)
        assert answer.status_code == 202 or 400 <= answer.status_code < 500, answer.text
        if answer.status_code == 202:
            found = wait_for(client, answer.json()["id"])
            assert found["state"] == "done" or not re.search("crash|killed|internal", found["error"]), found
            assert client.delete(found["url"]).status_code == 204
        else:
            assert answer.json()["detail"]


def test_metrics_are_those_of_prometheus(client):
    values = {
        sample.name: sample.value
        for family in text_string_to_metric_families(client.get("/metrics").text)
        for sample in family.samples
        if not sample.labels or sample.labels.get("state") == "done"
    }
    assert values["idesplat_scenes_total"] >= 5
    assert values["idesplat_workers_ready"] == 1
    assert values["idesplat_running"] == 0
    assert values["idesplat_stored_bytes"] > 0


def test_slow_senders_are_answered(slow_senders):
    threads, answers = slow_senders
    for thread in threads:
        thread.join(60)
    assert answers["headers"].startswith(b"HTTP/1.1 408 ")
    assert answers["body"].startswith(b"HTTP/1.1 408 ")


def test_results_that_are_removed_leave_nothing_behind(service, client, parts):
    url = wait_for(client, post(client, parts).json()["id"])["url"]
    folder = next(service.storage.glob(f"*/{url.rpartition('/')[2]}"))
    assert {path.name for path in folder.iterdir()} == {"out"}  # the images are gone with the end of the job
    assert client.delete(url).status_code == 204
    ends = time.monotonic() + 20
    while folder.exists() and time.monotonic() < ends:
        time.sleep(0.05)
    assert not folder.exists()


@pytest.mark.posix
def test_a_service_that_is_killed_takes_its_workers_with_it(service):
    """The last of these tests: no other finds the service."""
    workers = subprocess.run(["pgrep", "-P", str(service.process.pid)], capture_output=True, text=True).stdout
    service.process.kill()
    service.process.wait()
    ends = time.monotonic() + 30
    while any(map(is_running, map(int, workers.split()))) and time.monotonic() < ends:
        time.sleep(0.05)
    assert workers
    assert not any(map(is_running, map(int, workers.split())))


def is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return b" Z " not in subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True).stdout
