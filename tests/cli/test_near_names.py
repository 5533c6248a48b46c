"""A name that is nearly right is answered with the right one, whatever it is the name of."""

from __future__ import annotations

import pytest

from kinetix_dist.cli.main import main


@pytest.mark.parametrize(
    ("command", "meant"),
    [
        ("levels play s/hop_hom", "s/hop_home"),
        ("levels show hop_hom", "hop_home"),
        ("levels list desined_s", "designed_s"),
        ("edit s/hop_hom", "s/hop_home"),
        ("eval --policy random --levels randm_s", "random_s"),
        ("eval --checkpoint generalst --levels s/kick", "generalist"),
        ("levels play s/kick --policy generalst", "generalist"),
        ("levels generate out --generator kinetx", "kinetix"),
        ("train --recipe quickstrat", "quickstart"),
        ("train --curriculum.generator kinetx", "kinetix"),
        ("trian", "train"),
        ("bench scalign", "scaling"),
    ],
)
def test_the_nearest_name_is_asked_about(command, meant, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(command.split()) == 2
    line = capsys.readouterr().err
    assert f"did you mean {meant!r}?" in line and line.count("\n") == 1 and len(line) < 200


def test_a_name_like_no_other_is_answered_with_what_there_is(capsys):
    assert main(["levels", "list", "qqqq"]) == 2
    assert "unknown level set 'qqqq'; sets are designed_s" in capsys.readouterr().err
