"""Files of npm packages that the page needs: pinned in `third_party.json`, taken from where they lie or downloaded.

They are looked for in `vendor/` beside this module, which `make web` fills and a wheel may hold, then in the cache
folder; else the package is downloaded from the npm registry (`NPM_CONFIG_REGISTRY` names another). Whatever the source,
each file must have the SHA-256 that is written down, and a downloaded package its SHA-512.
"""

import base64
import hashlib
import io
import json
import os
import tarfile
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..system.cache_folder import cache_folder
from ..system.files import atomic_write
from ..system.progress import working

LIST = Path(__file__).with_name("third_party.json")
VENDOR = Path(__file__).with_name("vendor")
REGISTRY_VARIABLE = "NPM_CONFIG_REGISTRY"
DEFAULT_REGISTRY = "https://registry.npmjs.org"
TIMEOUT_S = 60
MAX_PACKAGE_BYTES = 1 << 27
ROOT_IN_PACKAGE = "package"  # the folder that holds everything in a package of npm
INTEGRITY_PREFIX = "sha512-"


@dataclass(frozen=True)
class PinnedFile:
    """source: path in its package. target: path in the page's folder `lib`. sha256: of its content, hexadecimal."""

    source: str
    target: str
    sha256: str


@dataclass(frozen=True)
class Package:
    """A package of npm, in one version. integrity: as package-lock.json has it, base64 of its SHA-512."""

    name: str
    version: str
    licence: str
    integrity: str
    files: list[PinnedFile]

    @property
    def address(self) -> str:
        """Where the registry has the package."""
        registry = os.environ.get(REGISTRY_VARIABLE, DEFAULT_REGISTRY).rstrip("/")
        return f"{registry}/{self.name}/-/{self.name.rpartition('/')[2]}-{self.version}.tgz"


def pinned_packages() -> list[Package]:
    """The packages of `third_party.json`."""
    document = json.loads(LIST.read_text(encoding="utf-8"))
    return [_package(entry) for entry in document["packages"]]


def _package(entry: dict[str, Any]) -> Package:
    return Package(**{**entry, "files": [PinnedFile(**file) for file in entry["files"]]})


def third_party_files(vendor: Path = VENDOR) -> dict[str, bytes]:
    """The content of every file, by its path in the page's folder `lib`.

    Raises InputError if a package has to be downloaded and cannot be, or is not the one that is pinned.
    """
    content: dict[str, bytes] = {}
    for package in pinned_packages():
        content |= _read(package, vendor) or _read(package, _cache(package)) or _download(package)
    return content


def store(folder: Path) -> list[Path]:
    """Write every file into a folder, for a wheel or a machine without network; returns their paths."""
    return [_write(folder / name, content) for name, content in third_party_files().items()]


def _cache(package: Package) -> Path:
    return cache_folder("web") / f"{package.name.replace('/', '-')}-{package.version}"


def _read(package: Package, folder: Path) -> dict[str, bytes] | None:
    """The files of a package in a folder; None unless all are there and as they are pinned."""
    found = {}
    for file in package.files:
        try:
            content = (folder / file.target).read_bytes()
        except OSError:
            return None
        if hashlib.sha256(content).hexdigest() != file.sha256:
            return None
        found[file.target] = content
    return found


def _download(package: Package) -> dict[str, bytes]:
    what = f"{package.name} {package.version}"
    with working(f"downloading {what}"):
        archive = _fetch(package.address, what)
    digest = INTEGRITY_PREFIX + base64.b64encode(hashlib.sha512(archive).digest()).decode()
    if digest != package.integrity:
        raise InputError(
            f"{package.address}: is not the {what} that is pinned (its SHA-512 differs); "
            f"set {REGISTRY_VARIABLE} to a registry that has the original"
        )
    found = {}
    with tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as members:
        for file in package.files:
            member = members.extractfile(f"{ROOT_IN_PACKAGE}/{file.source}")
            assert member is not None, f"{what} has no {file.source}, although its SHA-512 fits"
            found[file.target] = member.read()
    for name, content in found.items():
        _write(_cache(package) / name, content)
    return found


def _fetch(address: str, what: str) -> bytes:
    try:
        with urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer:
            content: bytes = answer.read(MAX_PACKAGE_BYTES)
    except (urllib.error.URLError, OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        raise InputError(
            f"{address}: {what}, which the page needs, cannot be downloaded ({reason}); connect to the network once, "
            f"set {REGISTRY_VARIABLE} to a registry that is in reach, or install a wheel that `make web` was run for"
        ) from None
    return content


def _write(path: Path, content: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return path


if __name__ == "__main__":
    store(VENDOR)
