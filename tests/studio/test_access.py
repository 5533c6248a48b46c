"""Access by token, cookie, Host, Origin and signed URL, and the headers of every response."""

from __future__ import annotations

import io
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from kinetix_dist.studio.server.access import VALID_SECONDS, Access, UrlSigner
from tests.studio.runs_for_tests import write_run
from tests.studio.serving import Server, end, serving


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    runs = tmp_path_factory.mktemp("runs")
    write_run(runs / "a")
    with serving(runs) as server:
        yield server


def without_cookie(server: Server, path: str, **headers: str) -> tuple[int, dict[str, str], str]:
    status, answered, content = server.request(path, headers={"Cookie": "", **headers})
    return status, answered, content.decode()


def test_the_token_is_exchanged_for_a_cookie_that_no_script_reads(server: Server) -> None:
    status, headers, content = without_cookie(server, f"/?token={server.token}")
    assert status == 200 and "url=./" in content and server.token not in content
    cookie = headers["Set-Cookie"]
    assert cookie.startswith(f"kinetix_dist_{server.port}=") and server.token not in cookie
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.parametrize("path", ["/", "/api/runs", "/static/app.js", "/channel", "/nothing"])
def test_nothing_is_answered_without_it(server: Server, path: str) -> None:
    status, _, content = without_cookie(server, path)
    assert status == 401 and "open the address with its token" in content


def test_a_browser_without_access_gets_a_page_that_takes_the_printed_address(server: Server) -> None:
    """Its script is open, and knows no token; other requests get one line."""
    status, headers, content = without_cookie(server, "/", Accept="text/html,*/*")
    assert status == 401 and headers["Content-Type"].startswith("text/html") and 'src="static/enter.js"' in content
    status, _, script = without_cookie(server, "/static/enter.js")
    assert status == 200 and server.token not in script + content
    assert without_cookie(server, "/api/runs", Accept="text/html")[2].startswith("no access")


@pytest.mark.parametrize("path", ["/favicon.ico", "/static/icon.svg"])
def test_everybody_gets_the_icon(server: Server, path: str) -> None:
    """Browsers request it with every page, also with the one that refuses access."""
    status, headers, content = server.request(path, headers={"Cookie": ""})
    assert status == 200 and headers["Content-Type"].startswith("image/") and 0 < len(content) < 2000


def test_every_page_links_its_icon(server: Server) -> None:
    """Relative to the page, so that it is found below the prefix of a proxy."""
    for page in (f"/?token={server.token}", "/"):
        content = server.request(page)[2].decode()
        assert '<link rel="icon" href="static/icon.svg" type="image/svg+xml" />' in content, page
    with Image.open(io.BytesIO(server.request("/rerun/favicon.ico")[2])) as icon:
        assert icon.format == "ICO" and {(16, 16), (32, 32)} <= icon.info["sizes"]


@pytest.mark.parametrize("token", ["", "x", "é"])
def test_a_wrong_token_is_refused(server: Server, token: str) -> None:
    from urllib.parse import quote

    status, headers, content = without_cookie(server, f"/?token={quote(token)}")
    assert status == 401 and content.startswith("wrong token") and "Set-Cookie" not in headers


def test_the_cookie_of_another_port_is_of_no_use(server: Server) -> None:
    name, value = server.cookie.split("=")
    assert without_cookie(server, "/api/runs", Cookie=f"{name}1={value}")[0] == 401
    assert without_cookie(server, "/api/runs", Cookie=f"{name}={value}x")[0] == 401
    assert without_cookie(server, "/api/runs", Cookie=f"{name}={value}")[0] == 200


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8650", "127.0.0.1.evil.example", "", "[::1", "::"])
def test_a_foreign_host_is_refused_with_the_cookie_too(server: Server, host: str) -> None:
    assert server.request("/api/runs", headers={"Host": host})[0] in (400, 403)


def test_a_foreign_origin_is_refused(server: Server) -> None:
    own = f"http://127.0.0.1:{server.port}"
    assert server.request("/api/runs", headers={"Origin": own})[0] == 200
    for origin in ("http://evil.example", "null", f"http://127.0.0.1:{server.port + 1}", "http://localhost"):
        assert server.request("/api/runs", headers={"Origin": origin})[0] == 403, origin


def test_other_names_are_allowed_when_they_are_given() -> None:
    access = Access(port=1, host="127.0.0.1", allowed_hosts=["Proxy.Example"])
    assert access.refusal_of_origin("proxy.example", "https://proxy.example:8443") is None
    assert access.refusal_of_origin("127.0.0.1:1", "https://proxy.example") is None, "a proxy may change Host"
    refusal = access.refusal_of_origin("other.example:1", None)
    assert refusal is not None and "--allow-host other.example" in refusal


def test_every_answer_carries_the_policy(server: Server) -> None:
    for path in ("/", "/api/runs", "/static/app.js", "/nothing", "/api/runs/none"):
        _, headers, _ = server.request(path)
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy and "connect-src 'self'" in policy and "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"


def test_it_listens_on_loopback_alone(server: Server) -> None:
    listening = Path(f"/proc/{server.process.pid}/net/tcp").read_text().splitlines()[1:]
    addresses = {line.split()[1] for line in listening if line.split()[3] == "0A"}
    own = {address for address in addresses if address.endswith(f":{server.port:04X}")}
    assert own == {f"0100007F:{server.port:04X}"}


def test_the_token_is_in_no_output_but_the_address(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    with serving(tmp_path) as server:
        server.request(f"/?token={server.token}")
        server.request(f"/api/runs/none?token={server.token}")
        assert "".join(server.lines).count(server.token) == 1
        output = end(server.process)
        assert isinstance(server.process, subprocess.Popen) and server.process.returncode == 0
    assert server.token not in output and output.strip() == ""


def test_a_signature_is_valid_for_its_name_and_its_time() -> None:
    signer = UrlSigner()
    signature = signer.sign("a.rrd", now=1000.0)
    assert signer.is_valid(signature, "a.rrd", now=1000.0 + VALID_SECONDS - 1)
    assert not signer.is_valid(signature, "a.rrd", now=1000.0 + VALID_SECONDS)
    assert not signer.is_valid(signature, "b.rrd", now=1000.0)
    assert not UrlSigner().is_valid(signature, "a.rrd", now=1000.0), "the key is new with every start"


@pytest.mark.parametrize("signature", ["", "-", "9999999999-", "x-y", "²-a", "99999999999999999999-a", "9999999999"])
def test_what_is_no_signature_is_refused(signature: str) -> None:
    assert not UrlSigner().is_valid(signature, "a.rrd", now=0.0)


def test_a_later_time_needs_another_signature() -> None:
    signer = UrlSigner()
    until, _, code = signer.sign("a.rrd", now=1000.0).partition("-")
    assert not signer.is_valid(f"{int(until) + 1}-{code}", "a.rrd", now=1000.0)
