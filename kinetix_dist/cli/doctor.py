"""`kinetix-dist doctor`: what this machine can run, and what is missing, with the remedy.

Imports nothing heavy itself: every library is tried in a process of its own (`doctor_probes`), so that a
broken one becomes a line of the report. Exit status 0 when `kinetix-dist train` can run here, else 1.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import os
import platform
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

from kinetix_dist import user_directories
from kinetix_dist.cli.doctor_probes import ProbeError, run_probe
from kinetix_dist.installation import ENGINE, engine_complaint, engine_note
from kinetix_dist.json_text import json_text

PACKAGE = "kinetix-dist"
MIN_PYTHON = (3, 11)
MIN_FREE_DISK_GB = 2.0  # a quickstart run writes under 0.2 GB; the rest is compile caches and ray's spill
MIN_MEMORY_GB = 4.0  # the quickstart run needs about 3
RAY_PORTS = {6379: "cluster head", 8265: "dashboard", 10001: "client"}  # ray's defaults; others are chosen if taken
_INSTALL = "run `make install` in the repository"


@dataclasses.dataclass(frozen=True)
class Args:
    """Report what this machine can run, and what is missing."""

    json: bool = False
    """Print the report as JSON instead of text."""
    require_gpu: bool = False
    """Fail where JAX or Warp cannot use a GPU."""
    run_dir: Path = Path("runs")
    """Directory of runs: checked for space and permission."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """One line of the report. Only `error` keeps training from running."""

    name: str
    status: Literal["ok", "warning", "error"]
    detail: str
    remedy: str = ""
    facts: dict[str, Any] = dataclasses.field(default_factory=dict)


def run(args: Args) -> int:
    """Prints the report; 0 when training can run here, else 1."""
    checks = list(diagnose(args))
    can_train = not any(check.status == "error" for check in checks)
    if args.json:
        print(json_text({"can_train": can_train, "checks": [dataclasses.asdict(c) for c in checks]}, indent=2))
    else:
        print(_as_text(checks, can_train))
    return 0 if can_train else 1


def diagnose(args: Args) -> Iterator[Check]:
    """All checks, in the order of the report."""
    yield check_python()
    yield check_hardware()
    yield from check_packages()
    engine = check_engine()
    yield engine
    if engine.status == "error":  # whatever needs it would say the same
        return
    yield check_warp(_probed("warp", _judge_warp, f"the physics kernel cannot be compiled; {_INSTALL}"))
    yield _probed("ray", _judge_ray, f"{_INSTALL}; without ray only local mode runs", failure="warning")
    jax_check = _probed("jax", _judge_jax, f"{_INSTALL}; to leave a broken GPU aside set JAX_PLATFORMS=cpu")
    yield jax_check
    yield check_gpu(jax_check, required=args.require_gpu)
    if jax_check.status == "ok":
        yield check_arithmetic(jax_check)
        yield check_kernels(jax_check)
    yield check_caches()
    yield check_disk(args.run_dir)
    yield check_shared_memory()
    yield check_ports()


def check_python() -> Check:
    found = platform.python_version()
    if sys.version_info < MIN_PYTHON:
        return Check(name="python", status="error", detail=found, remedy="use Python 3.11 or newer")
    return Check(name="python", status="ok", detail=f"{found} at {sys.executable}", facts={"version": found})


def check_hardware() -> Check:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    facts: dict[str, Any] = {"system": platform.platform(), "cores": cores}
    try:
        import psutil
    except ImportError:
        return Check(name="machine", status="ok", detail=f"{facts['system']}, {cores} cores", facts=facts)
    memory = psutil.virtual_memory()
    facts |= {"memory_gb": round(memory.total / 1e9, 1), "memory_free_gb": round(memory.available / 1e9, 1)}
    detail = f"{facts['system']}, {cores} cores, {facts['memory_free_gb']} of {facts['memory_gb']} GB memory free"
    if facts["memory_free_gb"] < MIN_MEMORY_GB:
        remedy = f"free memory: a small run on CPU needs about {MIN_MEMORY_GB:.0f} GB"
        return Check(name="machine", status="warning", detail=detail, remedy=remedy, facts=facts)
    return Check(name="machine", status="ok", detail=detail, facts=facts)


def check_packages() -> Iterator[Check]:
    """Installed versions against the ranges in this package's own metadata."""
    try:
        wanted = importlib.metadata.requires(PACKAGE) or []
        from packaging.requirements import Requirement
    except ImportError as error:  # PackageNotFoundError is one
        yield Check(name="packages", status="warning", detail=f"{PACKAGE}: {error}", remedy=_INSTALL)
        return
    versions, missing, outside = {}, [], []
    for requirement in map(Requirement, wanted):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            versions[requirement.name] = version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(requirement.name)
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            outside.append(f"{requirement.name} {version} (wanted {requirement.specifier})")
    if missing:
        detail = f"not installed: {', '.join(missing)}"
        yield Check(name="packages", status="error", detail=detail, remedy=_INSTALL, facts=versions)
    elif outside:
        yield Check(name="packages", status="warning", detail="; ".join(outside), remedy=_INSTALL, facts=versions)
    else:
        yield Check(name="packages", status="ok", detail=f"{len(versions)} as required", facts=versions)


def check_engine() -> Check:
    """Checks that `jax2d` is the engine of this installation and not the published package of that name."""
    if line := engine_complaint() or engine_note():
        detail, remedy = line.split("; ", 1)
        return Check(name="engine", status="error" if engine_complaint() else "warning", detail=detail, remedy=remedy)
    return Check(name="engine", status="ok", detail=f"jax2d at {ENGINE}", facts={"directory": str(ENGINE)})


def _probed(
    name: str,
    judge: Callable[[dict[str, Any]], str],
    remedy: str,
    failure: Literal["warning", "error"] = "error",
) -> Check:
    try:
        facts = run_probe(name)
    except ProbeError as error:
        return Check(name=name, status=failure, detail=str(error), remedy=remedy)
    return Check(name=name, status="ok", detail=judge(facts), facts=facts)


def _judge_jax(facts: dict[str, Any]) -> str:
    names = ", ".join(sorted(set(facts["devices"])))
    return f"{facts['version']}, {len(facts['devices'])} {facts['platform']} device(s): {names}"


def _judge_warp(facts: dict[str, Any]) -> str:
    kernels = []
    for device, result in facts["kernel"].items():
        works = f"compiled and run in {result['seconds']} s" if "seconds" in result else result["error"]
        kernels.append(f"kernel on {device}: {works}")
    return f"{facts['version']}, {'; '.join(kernels)}; {len(facts['cuda_devices'])} CUDA device(s)"


def check_warp(probed: Check) -> Check:
    """Judges the backends: one that works on some devices only is a warning, on none an error."""
    broken = [device for device, result in probed.facts.get("kernel", {}).items() if "error" in result]
    if not broken:
        return probed
    works_somewhere = len(broken) < len(probed.facts["kernel"])
    remedy = f"nothing can be simulated on {', '.join(broken)}; {_INSTALL}"
    return dataclasses.replace(probed, status="warning" if works_somewhere else "error", remedy=remedy)


def _judge_ray(facts: dict[str, Any]) -> str:
    return facts["version"]


def check_gpu(jax_check: Check, *, required: bool) -> Check:
    """Checks that there is an NVIDIA GPU and JAX uses it."""
    failure: Literal["warning", "error"] = "error" if required else "warning"
    try:
        driver = run_probe("driver")
    except ProbeError as error:
        if required:
            return Check(name="gpu", status="error", detail=str(error), remedy="install an NVIDIA driver, 525 or newer")
        return Check(name="gpu", status="ok", detail="none (no NVIDIA driver); everything runs on the CPU")
    detail = f"{driver['gpus']} GPU(s), driver for CUDA {driver['cuda_version']}"
    if driver["gpus"] == 0:
        remedy = "check CUDA_VISIBLE_DEVICES and the container's GPU option"
        return Check(name="gpu", status=failure, detail=detail, remedy=remedy, facts=driver)
    if jax_check.facts.get("platform") != "gpu":
        extra = "cuda13" if int(driver["cuda_version"].split(".")[0]) >= 13 else "cuda12"
        remedy = f"JAX does not use it: uv pip install -e '.[{extra}]', and unset JAX_PLATFORMS"
        return Check(name="gpu", status=failure, detail=detail, remedy=remedy, facts=driver)
    return Check(name="gpu", status="ok", detail=f"{detail}, used by JAX", facts=driver)


def check_kernels(jax_check: Check) -> Check:
    """Checks that `policy.kernels` "fused" can run. XLA computes the same everywhere, so its absence is no fault."""
    why_not = jax_check.facts["no_kernels"]
    detail = f"policy.kernels: xla only ({why_not})" if why_not else "policy.kernels: xla and fused"
    return Check(name="kernels", status="ok", detail=detail, facts={"fused": not why_not})


def check_arithmetic(jax_check: Check) -> Check:
    """Checks that JAX computes on the CPU what numpy does; some versions do not."""
    if complaint := jax_check.facts["wrong_arithmetic"]:
        detail, remedy = complaint.split("; ", 1)
        return Check(name="arithmetic", status="error", detail=detail, remedy=remedy)
    return Check(name="arithmetic", status="ok", detail="JAX and numpy agree on the CPU")


def check_caches() -> Check:
    """Writes a file to each directory that training writes to besides the run's own: compiled programs, Ray's files."""
    replaced = user_directories.settle()
    directories = cache_directories()
    failures = [f"{name} {path} ({why})" for name, path in directories.items() if (why := _why_not_written(path))]
    facts = {name: str(path) for name, path in directories.items()}
    if failures:
        remedy = "set JAX_COMPILATION_CACHE_DIR, WARP_CACHE_PATH and RAY_TMPDIR to directories that can be written"
        detail = f"cannot be written: {', '.join(failures)}"
        return Check(name="caches", status="error", detail=detail, remedy=remedy, facts=facts)
    if replaced:
        detail, remedy = replaced.split("; ", 1)
        return Check(name="caches", status="warning", detail=detail, remedy=remedy, facts=facts)
    written = ", ".join(f"{name} {path}" for name, path in directories.items())
    return Check(name="caches", status="ok", detail=f"written: {written}", facts=facts)


def cache_directories() -> dict[str, Path]:
    """Directories of JAX's, Warp's and Ray's files, as training finds them, by name."""
    from kinetix_dist.program_cache import directory_of

    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return {
        "compile cache": directory_of(""),
        "Warp cache": Path(os.environ.get("WARP_CACHE_PATH") or caches / "warp").absolute(),
        "Ray": Path(os.environ.get("RAY_TMPDIR") or "/tmp", "ray"),
    }


def _why_not_written(directory: Path) -> str:
    """Reason why no file can be written below `directory`, which is made where it is missing; empty: it can."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory) as file:
            file.write(b"written by kinetix-dist doctor")
    except OSError as error:
        return error.strerror or str(error)
    return ""


def check_disk(run_dir: Path) -> Check:
    existing = next(path for path in [run_dir.absolute(), *run_dir.absolute().parents] if path.exists())
    free_gb = round(shutil.disk_usage(existing).free / 1e9, 1)
    facts = {"run_dir": str(run_dir), "free_gb": free_gb}
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        detail = f"{existing} cannot be written: {error.strerror or error}"
        remedy = "choose another folder with --run-dir (train: --run)"
        return Check(name="disk", status="error", detail=detail, remedy=remedy, facts=facts)
    detail = f"{free_gb} GB free for {run_dir}"
    if free_gb < MIN_FREE_DISK_GB:
        remedy = f"free {MIN_FREE_DISK_GB:.0f} GB, or choose another folder"
        return Check(name="disk", status="error", detail=detail, remedy=remedy, facts=facts)
    return Check(name="disk", status="ok", detail=detail, facts=facts)


def check_shared_memory() -> Check:
    """Ray's object store lives in /dev/shm and falls back to the slower /tmp where that is small (containers)."""
    shm = Path("/dev/shm")
    if not shm.is_dir():
        return Check(name="shared memory", status="ok", detail="no /dev/shm on this system")
    free_gb = round(shutil.disk_usage(shm).free / 1e9, 1)
    if free_gb < 1.0:
        remedy = "start the container with a larger one, e.g. --shm-size=8g; ray is slow without"
        return Check(name="shared memory", status="warning", detail=f"{free_gb} GB free in /dev/shm", remedy=remedy)
    return Check(name="shared memory", status="ok", detail=f"{free_gb} GB free in /dev/shm")


def check_ports() -> Check:
    try:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
    except OSError as error:
        remedy = "allow sockets on the loopback interface: ray and jax.distributed need them"
        return Check(name="ports", status="error", detail=f"cannot bind 127.0.0.1: {error}", remedy=remedy)
    taken = [f"{port} ({use})" for port, use in RAY_PORTS.items() if _is_taken(port)]
    if taken:
        remedy = "fine on one machine, where free ports are chosen; a cluster needs `ray start --port`"
        return Check(name="ports", status="warning", detail=f"in use: {', '.join(taken)}", remedy=remedy)
    return Check(name="ports", status="ok", detail=f"loopback works; {', '.join(map(str, RAY_PORTS))} are free")


def _is_taken(port: int) -> bool:
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False


def _as_text(checks: list[Check], can_train: bool) -> str:
    signs = {"ok": "ok     ", "warning": "WARNING", "error": "ERROR  "}
    lines = []
    for check in checks:
        lines.append(f"{signs[check.status]}  {check.name:<14} {check.detail}")
        if check.remedy:
            lines.append(f"{'':<24} -> {check.remedy}")
    lines.append("")
    lines.append("training can run here" if can_train else "training cannot run here: mend the lines marked ERROR")
    return "\n".join(lines)
