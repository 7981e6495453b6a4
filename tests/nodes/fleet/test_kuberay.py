"""KubeRay's manifest: the rules of its API, and its parameters with real Ray. It does not run on Kubernetes here."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import yaml

from research.experiments.ray_nodes import free_port, ray_nodes
from semantic_mapper.nodes.fleet.cluster import connected
from semantic_mapper.nodes.launcher.launch_file import LAUNCH_FOLDER

ray = pytest.importorskip("ray")

MANIFEST = LAUNCH_FOLDER / "fleet" / "kuberay.yaml"
TABLES_PORT = 6379
# Options of `ray start` that KubeRay writes as --option=true; it writes others of value "true" as --option.
EXPLICIT = ("include-dashboard", "include-log-monitor", "log-color")
CLUSTER_FIELDS = {"rayVersion", "authOptions", "headGroupSpec", "workerGroupSpecs"}
HEAD_FIELDS = {"serviceType", "rayStartParams", "template"}
WORKER_FIELDS = {"groupName", "replicas", "minReplicas", "maxReplicas", "rayStartParams", "template"}


@pytest.fixture(scope="module")
def documents() -> dict[str, dict[str, Any]]:
    loaded = list(yaml.safe_load_all(MANIFEST.read_text(encoding="utf-8")))
    return {document["kind"]: document for document in loaded}


@pytest.fixture(scope="module")
def spec(documents: dict[str, dict[str, Any]]) -> dict[str, Any]:
    return documents["RayCluster"]["spec"]


def groups(spec: dict[str, Any]) -> list[dict[str, Any]]:
    return [spec["headGroupSpec"], *spec["workerGroupSpecs"]]


def options(parameters: dict[str, str]) -> tuple[str, ...]:
    """What KubeRay makes of ``rayStartParams``."""
    found = []
    for name, value in sorted(parameters.items()):
        if value in ("true", "false") and name not in EXPLICIT:
            found += [f"--{name}"] if value == "true" else []
        else:
            found.append(f"--{name}={value}")
    return tuple(found)


def job_words(documents: dict[str, dict[str, Any]]) -> list[list[str]]:
    """The commands of the Job's script, as lists of words."""
    (container,) = documents["Job"]["spec"]["template"]["spec"]["containers"]
    assert container["command"] == ["bash", "-c"]
    (script,) = container["args"]
    return [shlex.split(part) for part in script.split("&&")]


def test_the_manifest_has_a_cluster_a_policy_and_a_run(documents: dict[str, dict[str, Any]]) -> None:
    versions = {kind: document["apiVersion"] for kind, document in documents.items()}
    assert versions == {"RayCluster": "ray.io/v1", "NetworkPolicy": "networking.k8s.io/v1", "Job": "batch/v1"}
    for document in documents.values():
        assert re.fullmatch(r"[a-z]([-a-z0-9]*[a-z0-9])?", document["metadata"]["name"])


def test_fields_are_those_of_the_api(spec: dict[str, Any]) -> None:
    assert set(spec) == CLUSTER_FIELDS
    assert set(spec["headGroupSpec"]) == HEAD_FIELDS
    assert all(set(group) == WORKER_FIELDS for group in spec["workerGroupSpecs"])
    assert all(isinstance(value, str) for group in groups(spec) for value in group["rayStartParams"].values())
    names = [group["groupName"] for group in spec["workerGroupSpecs"]]
    assert len(set(names)) == len(names)
    for group in spec["workerGroupSpecs"]:
        assert 0 <= group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]


def test_the_manifest_names_the_ray_that_is_tested(spec: dict[str, Any]) -> None:
    assert spec["rayVersion"] == version("ray")


def test_every_container_declares_what_it_needs(documents: dict[str, dict[str, Any]], spec: dict[str, Any]) -> None:
    pods = [group["template"]["spec"] for group in groups(spec)] + [documents["Job"]["spec"]["template"]["spec"]]
    for pod in pods:
        (container,) = pod["containers"]
        assert container["image"] == "IMAGE"
        assert container["resources"]["requests"] == container["resources"]["limits"]
        assert {"cpu", "memory"} <= set(container["resources"]["limits"])
        assert pod["automountServiceAccountToken"] is False


def test_only_the_gpu_group_has_gpus_and_the_head_has_no_tasks(spec: dict[str, Any]) -> None:
    having = [
        group["groupName"]
        for group in spec["workerGroupSpecs"]
        if "nvidia.com/gpu" in group["template"]["spec"]["containers"][0]["resources"]["limits"]
    ]
    assert having == ["gpu"]
    assert spec["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"


def test_the_dashboard_is_off_and_probes_do_not_ask_it(spec: dict[str, Any]) -> None:
    head = spec["headGroupSpec"]
    assert head["rayStartParams"]["include-dashboard"] == "false"
    assert head["serviceType"] == "ClusterIP"
    (container,) = head["template"]["spec"]["containers"]
    assert [port["containerPort"] for port in container["ports"]] == [TABLES_PORT]
    expected = [TABLES_PORT] + [int(g["rayStartParams"]["node-manager-port"]) for g in spec["workerGroupSpecs"]]
    for probe in ("livenessProbe", "readinessProbe"):
        asked = [g["template"]["spec"]["containers"][0][probe]["tcpSocket"]["port"] for g in groups(spec)]
        assert asked == expected


def test_the_policy_lets_members_in_and_nobody_else(documents: dict[str, dict[str, Any]], spec: dict[str, Any]) -> None:
    policy = documents["NetworkPolicy"]["spec"]
    (label,) = policy["podSelector"]["matchLabels"].items()
    assert policy["policyTypes"] == ["Ingress"]
    assert policy["ingress"] == [{"from": [{"podSelector": policy["podSelector"]}]}]
    templates = [group["template"] for group in groups(spec)] + [documents["Job"]["spec"]["template"]]
    assert all(label in template["metadata"]["labels"].items() for template in templates)


def test_the_job_has_the_token_of_the_cluster(documents: dict[str, dict[str, Any]], spec: dict[str, Any]) -> None:
    assert spec["authOptions"] == {"mode": "token"}
    name = documents["RayCluster"]["metadata"]["name"]
    (container,) = documents["Job"]["spec"]["template"]["spec"]["containers"]
    variables = {entry["name"]: entry for entry in container["env"]}
    assert variables["RAY_ADDRESS"]["value"] == f"{name}-head-svc:{TABLES_PORT}"
    assert variables["RAY_AUTH_MODE"]["value"] == "token"
    # The operator's secret is called as the cluster.
    assert variables["RAY_AUTH_TOKEN"]["valueFrom"]["secretKeyRef"] == {"name": name, "key": "auth_token"}


def test_no_secret_is_in_the_manifest(documents: dict[str, dict[str, Any]]) -> None:
    assert "Secret" not in documents
    values = re.findall(r"value: (\S+)", MANIFEST.read_text(encoding="utf-8"))
    assert values == ['"1"}', '"fleet-head-svc:6379"}', "token}"]


@pytest.mark.slow
def test_ray_starts_with_the_parameters_of_the_manifest(
    documents: dict[str, dict[str, Any]], spec: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    head, worker = spec["headGroupSpec"]["rayStartParams"], spec["workerGroupSpecs"][0]["rayStartParams"]
    start, run = job_words(documents)
    assert start[:3] == ["ray", "start", "--address=$RAY_ADDRESS"]
    assert run[:4] == ["exec", "semantic-mapper", "fleet", "run"]
    assert run[run.index("--ray") : run.index("--ray") + 2] == ["--ray", "auto"]
    with ray_nodes(head_cpus=0, head_options=options(head)) as nodes:
        for name, value in nodes.environment.items():
            monkeypatch.setenv(name, value)
        # Pods have ports of their own; here another process may have this one.
        port = {"node-manager-port": str(free_port())}
        nodes.start_worker(cpus=1, options=options({**worker, **port}))
        nodes.start_worker(cpus=0, options=tuple(start[3:]))
        monkeypatch.setenv("RAY_ADDRESS", nodes.address)
        with connected("auto") as cluster:
            assert (cluster.nodes, cluster.cpus) == (3, 1.0)
            assert ray.get(ray.remote(one).remote()) == 1


def one() -> int:
    return 1


@pytest.mark.slow
def test_the_options_of_ray_start_exist(documents: dict[str, dict[str, Any]], spec: dict[str, Any]) -> None:
    command = [str(Path(sys.executable).parent / "ray"), "start", "--help"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    named = {name for group in groups(spec) for name in group["rayStartParams"]}
    named |= {word.removeprefix("--").split("=")[0] for word in job_words(documents)[0] if word.startswith("--")}
    assert all(f"--{name} " in said for name in named)
