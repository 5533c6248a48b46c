"""`kinetix-dist levels render`: starts and rollouts of one level or of many, as PNG and as GIF."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from kinetix_dist.cli.main import main
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.proof import read_proof

GREEN, BLUE = (70, 178, 98), (58, 118, 224)  # jax2d.palette.ROLE_PALETTE


def render(*argv: str) -> int:
    return main(["levels", "render", *argv])


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def num_near(image: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((np.abs(image - colour).max(axis=-1) < 12).sum())


def test_a_start_is_drawn_with_its_green_shape_and_show_draws_the_same(tmp_path: Path) -> None:
    assert render("s/hop_home", str(tmp_path / "a.png")) == 0
    image = pixels(tmp_path / "a.png")
    assert image.shape == (524, 524, 3)  # 5.24 m with 100 pixels each
    assert num_near(image, GREEN) > 500
    assert main(["levels", "show", "s/hop_home", "--picture", str(tmp_path / "b.png")]) == 0
    np.testing.assert_array_equal(image, pixels(tmp_path / "b.png"))


def test_many_levels_are_a_grid(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert render("random_s", str(tmp_path / "six.png"), "--count", "6", "--columns", "3") == 0
    six = pixels(tmp_path / "six.png")
    assert render("random_s", str(tmp_path / "three.png"), "--count", "3", "--columns", "3") == 0
    three = pixels(tmp_path / "three.png")
    assert six.shape[1] == three.shape[1] and six.shape[0] > 1.8 * three.shape[0]
    np.testing.assert_array_equal(six[: three.shape[0] - 10], three[:-10])  # the same first levels
    assert capsys.readouterr().out.count("wrote ") == 2


def test_a_proof_moves_in_real_time_from_the_start_to_the_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "proof.gif"
    assert render("s/trapdoor", str(file), "--by", "proof") == 0
    proof = read_proof(levels_root() / "proofs" / "s" / "trapdoor.json")
    assert f"trapdoor: solved after {proof.num_steps} steps" in capsys.readouterr().out
    with Image.open(file) as image:
        frames = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(image)]
        image.seek(0)
        seconds = sum(frame.info["duration"] for frame in ImageSequence.Iterator(image)) / 1000
    np.testing.assert_allclose(seconds, proof.num_steps / 30 + 1.0, atol=0.1)  # the end stays for a second
    assert len(frames) >= proof.num_steps // 2
    assert (np.abs(frames[0] - frames[-1]).max(axis=-1) > 40).sum() > 100  # something has moved


@pytest.mark.long
def test_rollouts_without_a_policy_and_with_one_are_drawn_side_by_side(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "levels"
    folder.mkdir()
    for name in ("kick", "trapdoor"):
        (folder / f"{name}.json").write_text((levels_root() / "s" / f"{name}.json").read_text())
    assert render(str(folder), str(tmp_path / "noop.png"), "--by", "noop") == 0
    assert "kick: out of time after 256 steps" in capsys.readouterr().out
    assert render(str(folder), str(tmp_path / "s.gif"), "--by", "trained", "--checkpoint", "generalist") == 0
    with Image.open(tmp_path / "s.gif") as image:
        assert image.size[0] > 1.9 * image.size[1] / 1.2  # two beside each other
        assert image.n_frames > 5  # type: ignore[attr-defined]


def test_a_proof_of_another_level_is_refused_by_its_hash(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "levels"
    folder.mkdir()
    document = json.loads((levels_root() / "s" / "trapdoor.json").read_text())
    document["gravity"] = [0.0, -5.0]
    (folder / "trapdoor.json").write_text(json.dumps(document))
    proof = (levels_root() / "proofs" / "s" / "trapdoor.json").read_text()
    (folder / "trapdoor.proof.json").write_text(proof)
    assert render(str(folder / "trapdoor.json"), str(tmp_path / "x.png"), "--by", "proof") == 2
    assert "no proof can be shown; trapdoor: " in capsys.readouterr().err
    assert not (tmp_path / "x.png").exists()


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["s/kick", "a.mp4"], "a.mp4 is neither .png nor .gif"),
        (["s/kick", "a.gif"], "how a level starts does not move"),
        (["s/kick", "no/a.png"], "cannot write no/a.png"),
        (["s/kick", "a.gif", "--by", "trained"], "--by trained needs --checkpoint"),
        (["s/kick", "a.gif", "--by", "noop", "--checkpoint", "generalist"], "nothing else takes one"),
        (["s/kick", "a.gif", "--by", "noop", "--env.preset", "nosuch"], "unknown preset 'nosuch'"),
        (["random_s", "a.gif", "--by", "proof"], "drawn when it is used"),
        (["random_s", "a.png", "--count", "0"], "--count is 0; give 1 or more"),
        (["nosuch", "a.png"], "unknown level set 'nosuch'"),
    ],
)
def test_what_is_wrong_is_one_line(
    argv: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert render(*argv) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
