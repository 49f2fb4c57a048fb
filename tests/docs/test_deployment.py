"""The Dockerfile and the Kubernetes manifest fit the command, the service's paths and each other."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from idesplat.runtime.cli.application import app
from idesplat.runtime.cli.serve import PORT
from idesplat.runtime.service.limits import TOKEN_VARIABLE
from idesplat.runtime.service.protection import OPEN_PATHS
from idesplat.runtime.service.server import CLOSE_S
from idesplat.runtime.service.service import LINGER_S

ROOT = Path(__file__).parents[2]
UNITS = {"Ki": 1 << 10, "Mi": 1 << 20, "Gi": 1 << 30}


def parsed(words: list[str]) -> dict[str, Any]:
    """The options of a line that calls `idesplat`, as the command reads them."""
    group = typer.main.get_command(app)
    with group.make_context("idesplat", [], resilient_parsing=True) as context:
        _, command, rest = group.resolve_command(context, words)
        with command.make_context(words[0], rest, parent=context) as parsed_context:
            return parsed_context.params


@pytest.fixture(scope="module")
def stages() -> dict[str, str]:
    """The stages of the Dockerfile, by name."""
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    return dict(re.findall(r"^FROM \S+ AS (\w+)\n(.*?)(?=^FROM|\Z)", text, re.DOTALL | re.MULTILINE))


@pytest.fixture(scope="module")
def manifest() -> dict[str, Any]:
    documents = yaml.safe_load_all((ROOT / "docs" / "examples" / "kubernetes.yaml").read_text())
    return {document["kind"]: document for document in documents}


def words_of(stage: str, instruction: str) -> list[str]:
    (line,) = re.findall(rf"^{instruction} \[(.*)\]$", stage, re.MULTILINE)
    return shlex.split(line.replace(",", " "))


def test_images_run_commands_that_exist(stages: dict[str, str]) -> None:
    assert list(stages) == ["base", "service", "command"]  # the last is built without --target
    for name in ("service", "command"):
        words = words_of(stages[name], "ENTRYPOINT") + words_of(stages[name], "CMD")
        assert words[0] == "idesplat"
        options = parsed(words[1:])
        assert re.search(r"^USER [1-9]\d*:[1-9]\d*$", stages[name], re.MULTILINE)
    options = parsed((words_of(stages["service"], "ENTRYPOINT") + words_of(stages["service"], "CMD"))[1:])
    assert (options["host"], options["port"]) == ("0.0.0.0", PORT)
    assert f"EXPOSE {PORT}\n" in stages["service"]
    (path,) = re.findall(rf"http://127\.0\.0\.1:{PORT}(/\w+)", stages["service"])
    assert path in OPEN_PATHS


def test_the_manifest_fits_the_command(stages: dict[str, str], manifest: dict[str, Any]) -> None:
    pod = manifest["Deployment"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    options = parsed([*words_of(stages["service"], "ENTRYPOINT")[1:], *container["args"]])
    (port,) = container["ports"]
    assert port["containerPort"] == options["port"]
    for probe in ("startupProbe", "livenessProbe", "readinessProbe"):
        assert container[probe]["httpGet"]["path"] in OPEN_PATHS
        assert container[probe]["httpGet"]["port"] == port["name"]
    assert container["readinessProbe"]["httpGet"]["path"] == "/ready"
    (variable,) = container["env"]
    assert variable["name"] == TOKEN_VARIABLE
    assert "secretKeyRef" in variable["valueFrom"]
    assert pod["terminationGracePeriodSeconds"] > options["stop_after"] + LINGER_S + CLOSE_S
    limit = container["resources"]["limits"]["memory"]
    assert options["workers"] * options["max_memory"] * UNITS["Gi"] < int(limit[:-2]) * UNITS[limit[-2:]]
    mounted = {mount["mountPath"]: mount["name"] for mount in container["volumeMounts"]}
    volumes = {volume["name"]: volume["emptyDir"]["sizeLimit"] for volume in pod["volumes"]}
    size = volumes[mounted[str(options["storage"])]]
    assert options["max_storage"] * UNITS["Gi"] < int(size[:-2]) * UNITS[size[-2:]]
    assert "/tmp" in mounted  # the only place that is written to besides


def test_the_manifest_gives_no_rights_and_finds_its_pods(manifest: dict[str, Any]) -> None:
    deployment, service = manifest["Deployment"]["spec"], manifest["Service"]["spec"]
    pod = deployment["template"]["spec"]
    (container,) = pod["containers"]
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["runAsUser"] > 0
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    labels = deployment["template"]["metadata"]["labels"]
    assert deployment["selector"]["matchLabels"].items() <= labels.items()
    assert service["selector"].items() <= labels.items()
    assert service["ports"][0]["targetPort"] == container["ports"][0]["name"]
    assert deployment["replicas"] == 1  # a scene is known to the pod that took it
