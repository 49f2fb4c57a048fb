"""The npm files of the page: pinned, taken from where they lie, and refused where they differ."""

import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest
from idesplat.runtime.errors import InputError
from idesplat.runtime.web import third_party


@pytest.fixture
def no_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_every_file_is_pinned() -> None:
    packages = third_party.pinned_packages()
    assert {package.licence for package in packages} == {"MIT"}
    for package in packages:
        assert package.integrity.startswith("sha512-")
        assert all(len(file.sha256) == 64 for file in package.files)


def test_offline_says_what_to_do(no_cache, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(third_party.REGISTRY_VARIABLE, "http://127.0.0.1:9")
    with pytest.raises(InputError, match="which the page needs, cannot be downloaded"):
        third_party.third_party_files(tmp_path / "vendor")


def test_another_package_is_refused(no_cache, tmp_path, monkeypatch) -> None:
    package = third_party.pinned_packages()[0]
    archive = tmp_path / "registry" / package.name / "-" / f"{package.name}-{package.version}.tgz"
    archive.parent.mkdir(parents=True)
    archive.write_bytes(b"something else")
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path / "registry"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setenv(third_party.REGISTRY_VARIABLE, f"http://127.0.0.1:{server.server_address[1]}")
        with pytest.raises(InputError, match="SHA-512 differs"):
            third_party.third_party_files(tmp_path / "vendor")
        server.shutdown()


def test_a_changed_file_is_not_used(no_cache, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(third_party.REGISTRY_VARIABLE, "http://127.0.0.1:9")
    for package in third_party.pinned_packages():
        for file in package.files:
            path = tmp_path / "vendor" / file.target
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"changed")
    with pytest.raises(InputError, match="cannot be downloaded"):
        third_party.third_party_files(tmp_path / "vendor")
