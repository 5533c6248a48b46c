"""Pages, play, attempts and rerun once more on a machine without a network: in a network namespace of its own that
has loopback alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.browser.conftest import TRAINED_VARIABLE
from tests.helpers import REPOSITORY, python_path

# Loopback is up (SIOCSIFFLAGS, IFF_UP | IFF_RUNNING), and nothing else can be reached.
INSIDE = """
import fcntl, os, socket, struct, sys
probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
fcntl.ioctl(probe, 0x8914, struct.pack("16sh14x", b"lo", 0x41))
assert [name for _, name in socket.if_nameindex()] == ["lo"], socket.if_nameindex()
try:
    socket.create_connection(("192.0.2.1", 80), timeout=5)
    sys.exit("there is a network here")
except OSError as error:
    assert error.errno in (101, 113), error  # ENETUNREACH, EHOSTUNREACH
os.execv(sys.executable, [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *sys.argv[1:]])
"""
VISITED = (
    "tests/browser/test_pages.py::test_from_the_list_to_every_page_of_a_real_run",
    "tests/browser/test_pages.py::test_a_level_of_the_buffer_is_played_in_place",
    "tests/browser/test_editor.py::test_a_policy_plays_with_its_value_and_64_attempts_have_an_interval",
    "tests/browser/test_rerun.py",
)


@pytest.mark.slow  # two minutes: what it visits has been visited
def test_all_of_it_without_a_network(trained: Path) -> None:
    unshare = shutil.which("unshare")
    if unshare is None:
        pytest.skip("there is no unshare here")
    options = ["--net"] if os.geteuid() == 0 else ["--net", "--map-root-user"]
    if subprocess.run([unshare, *options, "true"], capture_output=True, check=False).returncode:
        pytest.skip("this machine allows no network namespace")
    done = subprocess.run(
        [unshare, *options, sys.executable, "-c", INSIDE, *VISITED],
        cwd=REPOSITORY,
        env=os.environ | {"PYTHONPATH": python_path(), TRAINED_VARIABLE: str(trained)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "skipped" not in done.stdout, done.stdout
