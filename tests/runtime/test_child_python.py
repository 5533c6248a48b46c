"""Python processes import what the process that starts them does, in whatever directory they start."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from ray.core.generated import common_pb2
from ray.job_config import JobConfig

import kinetix_dist
from kinetix_dist.child_python import (
    command_of,
    difference_of_imports,
    directories_outside_python,
    import_path,
    imported_from,
)
from kinetix_dist.runtime.processes.measures import refuse_other_imports, whereabouts
from kinetix_dist.runtime.processes.placement import PlacementError
from kinetix_dist.runtime.processes.ray_setup import job_of_this_import_path
from tests.helpers import PATIENCE_S, REPOSITORY
from tests.runtime.foreign_checkout import foreign_checkout

LOOK = """
import importlib.util, json, sys
import kinetix_dist
print(json.dumps([kinetix_dist.__file__, importlib.util.find_spec("jax").origin, sys.argv[1:], __name__]))
"""


@pytest.mark.parametrize("target", ["script.py", "look"])
def test_a_child_in_another_checkout_imports_what_its_parent_does(tmp_path, monkeypatch, target):
    modules = tmp_path / "modules"
    modules.mkdir()
    (modules / "look.py").write_text(LOOK)
    (modules / "script.py").write_text(LOOK)
    monkeypatch.syspath_prepend(str(modules))
    command = command_of(str(modules / target) if target.endswith(".py") else target, "a b", 7)
    elsewhere = foreign_checkout(tmp_path)
    done = subprocess.run(command, cwd=elsewhere, capture_output=True, text=True, timeout=PATIENCE_S)
    package, jax, arguments, name = json.loads(done.stdout)
    assert package == kinetix_dist.__file__ and Path(jax).name == "__init__.py"
    assert (arguments, name) == (["a b", "7"], "__main__")


def test_an_import_path_means_the_same_in_another_directory(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", "beside", "/at/a/place"])
    assert import_path() == [str(tmp_path), str(tmp_path / "beside"), "/at/a/place"]


def test_what_an_editable_installation_puts_on_the_path_stays_as_it_is(monkeypatch):
    monkeypatch.setattr(sys, "path", ["__editable__.mine-0.1.finder.__path_hook__"])
    assert import_path() == sys.path


def test_ray_hands_on_checkouts_and_neither_the_current_directory_nor_this_python(monkeypatch):
    monkeypatch.setattr(sys, "path", ["/a/checkout", *sys.path])
    assert not [path for path in directories_outside_python() if path.startswith(sys.prefix)]
    job = job_of_this_import_path()
    assert isinstance(job, JobConfig)
    job._py_driver_sys_path.append("/the/current/directory")  # as ray.init does
    parsed = common_pb2.JobConfig.FromString(job._serialize())
    assert list(parsed.py_driver_sys_path) == directories_outside_python()[::-1]
    assert parsed.py_driver_sys_path[-1] == "/a/checkout"  # inserted last, so it comes first


def test_a_process_that_imports_from_elsewhere_is_refused_in_one_line():
    where = {**whereabouts(None), "imports": imported_from()}
    refuse_other_imports("worker 0", where)
    where["imports"] |= {"kinetix_dist": "/another/kinetix_dist"}
    with pytest.raises(PlacementError, match=r"^worker 0 imports kinetix_dist from /another/.* instead of .*;"):
        refuse_other_imports("worker 0", where)
    refuse_other_imports("worker 0", where | {"host": "another"})  # nodes are compared by versions


def test_packages_that_only_one_of_two_has_imported_are_not_compared():
    assert difference_of_imports({"kinetix_dist": imported_from()["kinetix_dist"], "torch": "/torch"}) == ""


def test_nothing_starts_python_by_itself():
    """`command_of` is the one place. The others name sys.executable for another reason."""
    others = {
        "kinetix_dist/cli/doctor.py",  # says which Python runs
        "kinetix_dist/runtime/processes/fork_client.py",  # goes on as Ray's own script, which knows the import path
        "kinetix_dist/sweep/slots.py",  # becomes a command of command_of
        "bench/compare_revisions.py",  # runs another revision of the engine
    }
    sources = [path for folder in ("kinetix_dist", "jax2d", "bench") for path in (REPOSITORY / folder).rglob("*.py")]
    starts = {str(path.relative_to(REPOSITORY)) for path in sources if re.search(r"sys\.executable", path.read_text())}
    assert starts == others | {"kinetix_dist/child_python.py"}
