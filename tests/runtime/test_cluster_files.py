"""The files of cluster/: what their schemas say, and Slurm's script with a scheduler that runs everything here."""

import json
import os
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from tests.helpers import PATIENCE_S, REPOSITORY, python_path
from tests.runtime.raylets import RAY
from tests.runtime.test_stopping import STUBS, write_script
from tests.runtime.train_process import TINY

CLUSTER = REPOSITORY / "cluster"
# Of the published types of KubeRay (ray.io/v1): the fields of each object that the manifest has. No schema of pods is
# at hand: what is inside `template.spec` is checked by name only.
KUBERAY = {
    "": {"apiVersion", "kind", "metadata", "spec"},
    "spec": {
        *("activeDeadlineSeconds", "backoffLimit", "rayClusterSpec", "submitterPodTemplate", "metadata"),
        *(
            "clusterSelector",
            "submitterConfig",
            "managedBy",
            "deletionStrategy",
            "entrypoint",
            "runtimeEnvYAML",
            "jobId",
        ),
        *("jobId", "submissionMode", "entrypointResources", "entrypointNumCpus", "entrypointNumGpus", "suspend"),
        *("ttlSecondsAfterFinished", "shutdownAfterJobFinishes"),
    },
    "spec.rayClusterSpec": {"headGroupSpec", "workerGroupSpecs", "rayVersion", "headServiceAnnotations", "suspend"},
    "spec.rayClusterSpec.headGroupSpec": {"serviceType", "headService", "enableIngress", "rayStartParams", "template"},
    "spec.rayClusterSpec.workerGroupSpecs": {
        *("groupName", "replicas", "minReplicas", "maxReplicas", "numOfHosts", "rayStartParams", "template"),
        "scaleStrategy",
    },
}


def _parts(value, path):
    """The object, or the objects of the list, at a path of names."""
    for name in filter(None, path.split(".")):
        value = value[name]
    return value if isinstance(value, list) else [value]


def test_the_manifest_of_kuberay_has_known_fields_the_token_and_the_shared_directory():
    manifest = yaml.safe_load((CLUSTER / "kuberay.yaml").read_text())
    assert (manifest["apiVersion"], manifest["kind"]) == ("ray.io/v1", "RayJob")
    for path, known in KUBERAY.items():
        for part in _parts(manifest, path):
            assert set(part) <= known, path
    spec = manifest["spec"]
    cluster = spec["rayClusterSpec"]
    groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
    for group in groups:
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())  # a map of strings
        volumes = {volume["name"] for volume in group["template"]["spec"]["volumes"]}
        assert {"shared", "shm"} <= volumes
    for template in [spec["submitterPodTemplate"], *(group["template"] for group in groups)]:
        (container,) = template["spec"]["containers"]
        assert {"name", "image", "env"} <= set(container)
        environment = {variable["name"]: variable for variable in container["env"]}
        assert environment["RAY_AUTH_MODE"]["value"] == "token"
        assert environment["RAY_AUTH_TOKEN"]["valueFrom"]["secretKeyRef"]["key"] == "token"


@pytest.mark.parametrize("exists", [False, True])
def test_the_entrypoint_of_kuberay_begins_a_run_and_goes_on_with_it(tmp_path, exists):
    entrypoint = yaml.safe_load((CLUSTER / "kuberay.yaml").read_text())["spec"]["entrypoint"]
    if exists:
        (tmp_path / "m1").mkdir()
        (tmp_path / "m1" / "config.json").write_text("{}")
    write_script(tmp_path / "bin" / "kinetix-dist", '#!/bin/sh\necho "$@"\n')
    done = subprocess.run(
        ["sh", "-c", entrypoint.replace("/shared/runs", str(tmp_path))],
        env={"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    resume = ["--resume"] if exists else []
    assert done.stdout.split() == ["train", "--recipe", "sfl_m", "--run", str(tmp_path / "m1"), *resume]


def test_the_cluster_file_of_ray_is_what_ray_up_takes(tmp_path, monkeypatch):
    from ray.autoscaler._private.local import config as local_config
    from ray.autoscaler._private.util import prepare_config, validate_config

    monkeypatch.setattr(local_config, "get_lock_path", lambda name: str(tmp_path / f"{name}.lock"))
    monkeypatch.setattr(local_config, "get_state_path", lambda name: str(tmp_path / f"{name}.state"))
    config = yaml.safe_load((CLUSTER / "ray_cluster.yaml").read_text())
    starts = [*config["head_start_ray_commands"], *config["worker_start_ray_commands"]]
    validate_config(prepare_config(config))
    starting = [line for line in starts if " start " in line]
    assert len(starting) == 2 and all("RAY_AUTH_MODE=token" in line for line in starting)


def test_the_options_of_ray_start_that_the_files_use_exist():
    known = set(re.findall(r"--[a-z][a-z-]+", subprocess.run([RAY, "start", "--help"], **_TEXT).stdout))
    used = set()
    for name in ("ray_cluster.yaml", "slurm.sbatch", "README.md"):
        for line in (CLUSTER / name).read_text().splitlines():
            if "ray start " in line:
                used |= set(re.findall(r"--[a-z][a-z-]+", line.partition("ray start ")[2]))
    assert {"--head", "--port", "--address", "--block"} <= used <= known


_TEXT = {"capture_output": True, "text": True, "check": True}


@pytest.mark.slow
def test_the_slurm_script_trains_on_two_nodes_of_real_ray(tmp_path):
    """Its own commands, its token and its count of nodes; the scheduler is a stub that runs everything here, and two
    nodes have one address, which Ray allows."""
    nodes = {**STUBS, "scontrol": "echo node1; echo node2", "sleep": 'exec /bin/sleep "$@"'}
    nodes["hostname"] = f"{Path('/bin/hostname')} -I 2>/dev/null || echo 127.0.0.1"
    for name, body in nodes.items():
        write_script(tmp_path / "stubs" / name, f"#!/bin/sh\n{body}\n")
    programs = Path(RAY).parent
    write_script(tmp_path / ".venv" / "bin" / "ray", f'#!/bin/sh\nexec {RAY} "$@" --num-cpus=4\n')
    write_script(tmp_path / ".venv" / "bin" / "python", f'#!/bin/sh\nexec {programs / "python"} "$@"\n')
    command = f'#!/bin/sh\nexec {programs / "python"} -m kinetix_dist.cli.main "$@"\n'
    write_script(tmp_path / ".venv" / "bin" / "kinetix-dist", command)
    (tmp_path / "cluster").symlink_to(CLUSTER)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    environment |= {"PATH": f"{tmp_path / 'stubs'}:{os.environ['PATH']}", "PYTHONPATH": python_path()}
    environment |= {"SLURM_SUBMIT_DIR": str(tmp_path), "SLURM_JOB_ID": str(os.getpid()), "SLURM_JOB_NODELIST": "x"}
    environment |= {"SLURM_NNODES": "2", "JAX_PLATFORMS": "cpu", "HOME": str(tmp_path), "RAY_USAGE_STATS_ENABLED": "0"}
    options = [*TINY, "--run.total_env_steps", "256", "--run.placement", "colocated", "--run.num_workers", "2"]
    log = tmp_path / "log"
    with log.open("w") as file:  # a file: job steps that are left would keep a pipe open
        job = subprocess.Popen(
            ["bash", "cluster/slurm.sbatch", "train", "--run", str(tmp_path / "run"), *options],
            env=environment,
            cwd=tmp_path,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        status = job.wait(timeout=300)
    finally:
        _end_session(job.pid)
    assert status == 0, log.read_text()[-3000:]
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["policy_updates"] == 2 and report["device"]["count"] == 2


def _end_session(session: int) -> None:
    """Ends a session as the scheduler does: job steps that are left, and their processes."""
    import psutil

    for process in psutil.process_iter():
        try:
            is_ours = os.getsid(process.pid) == session
        except ProcessLookupError:
            continue
        if is_ours:
            for member in [*process.children(recursive=True), process]:
                try:
                    member.kill()
                except psutil.NoSuchProcess:
                    continue


@pytest.mark.slow
def test_a_bundle_installs_where_there_is_no_network(tmp_path):
    """Made with a network; installed and used in a network namespace that has none."""
    without_network = ["unshare", "--map-root-user", "--net"]
    if subprocess.run([*without_network, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no network namespaces here (unshare)")
    environment = {**os.environ, "PYTHON": str(Path(RAY).with_name("python"))}
    made = subprocess.run(["bash", CLUSTER / "bundle.sh", tmp_path / "bundle"], env=environment, check=False, **_OUTPUT)
    assert made.returncode == 0, made.stdout[-2000:]
    script = (
        f"bash {tmp_path}/bundle/install.sh {tmp_path}/venv && cd {tmp_path} && "
        f"{tmp_path}/venv/bin/kinetix-dist train --recipe tiny --evaluation.sets s/kick --run.total_env_steps 256"
    )
    environment = {name: value for name, value in environment.items() if name not in ("PYTHONPATH", "PYTHON")}
    used = subprocess.run([*without_network, "sh", "-c", script], env=environment, check=False, **_OUTPUT)
    assert used.returncode == 0, used.stdout[-2000:]
    assert (tmp_path / "runs" / "tiny" / "report.json").is_file()


_OUTPUT = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
