"""A policy of the public package: imported, played, recorded, trained on; and what cannot be imported."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.checkpoint import CheckpointError, load_checkpoint, select_arrays
from kinetix_dist.checkpoint.arrays import SafetensorsError, read_safetensors
from kinetix_dist.cli.main import main
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.evaluation.load_policy import PARAMS_PREFIX
from kinetix_dist.models.policy import PolicyConfig
from kinetix_dist.runtime.driver.checkpoints import starting_point
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan
from tests.kinetix_package import write_formula_policy, write_policy
from tests.runtime.runs import final_arrays, run_updates, tiny_config

SMALL = {
    "transformer_encoder_size": 8,
    "transformer_size": 8,
    "transformer_depth": 1,
    "actor_width": 8,
    "critic_width": 8,
    "actor_depth": 1,
    "critic_depth": 1,
}
POLICY = PolicyConfig(
    network="transformer_kinetix", encoder_size=8, attention_features=8, num_layers=1, hidden_size=8, hidden_layers=1
)
KICK = "s/kick"


@pytest.fixture(scope="module")
def package_policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_formula_policy(tmp_path_factory.mktemp("package") / "policy", **SMALL)


@pytest.fixture(scope="module")
def imported(package_policy: Path) -> Path:
    to = package_policy.parent / "imported"
    assert main(["import-checkpoint", str(package_policy), "--out", str(to)]) == 0
    return to


def test_eval_and_replay_take_an_imported_policy(
    imported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rates, recording = tmp_path / "rates.json", tmp_path / "kick.mcap"
    options = ["--attempts", "2", "--no-baselines", "--json", str(rates), "--record", str(recording)]
    assert main(["eval", "--checkpoint", str(imported), "--levels", KICK, *options]) == 0
    assert json.loads(rates.read_text())["solve_rate"]["trained"]["attempts"] == 2
    assert main(["replay", str(recording), "--list"]) == 0
    assert "kick" in capsys.readouterr().out


@pytest.mark.slow
def test_an_imported_policy_of_the_papers_size_plays_a_public_level(public_levels: Path, tmp_path: Path) -> None:
    policy = write_formula_policy(tmp_path / "policy", legacy_entity_id=True)
    assert main(["import-checkpoint", str(policy), "--out", str(tmp_path / "imported")]) == 0
    level = sorted((public_levels / "m").glob("*.json"))[0]
    assert main(["eval", "--checkpoint", str(tmp_path / "imported"), "--levels", str(level), "--attempts", "1"]) == 0


def _config(imported: Path, policy: PolicyConfig = POLICY) -> TrainConfig:
    config = tiny_config(num_updates=2, start_from=str(imported))
    env = dataclasses.replace(config.env, observation="entity_kinetix")
    curriculum = CurriculumConfig(name="fixed", levels=KICK)
    return dataclasses.replace(config, env=env, policy=policy, curriculum=curriculum)


@pytest.mark.long
def test_training_goes_on_from_an_imported_policy(imported: Path, tmp_path: Path) -> None:
    config, backend = _config(imported), LocalBackend()
    trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
    given = starting_point(config).arrays
    trainer.start(0, given)
    before = select_arrays(trainer.snapshot(), PARAMS_PREFIX)
    for name, array in select_arrays(load_checkpoint(imported).arrays, PARAMS_PREFIX).items():
        np.testing.assert_array_equal(before[name], array)
    run_updates(config, tmp_path / "run", trainer, None)
    after = select_arrays(final_arrays(tmp_path / "run"), PARAMS_PREFIX)
    assert all(np.isfinite(array).all() for array in after.values())
    moved = [np.abs(after[name] - before[name]).max() for name in before]
    assert 0.0 < max(moved) < 0.1  # 8 steps of Adam at 1e-3: it is still that policy
    assert config.hash != dataclasses.replace(config, run=dataclasses.replace(config.run, start_from="")).hash


def test_a_run_cannot_start_from_another_network(imported: Path) -> None:
    with pytest.raises(CheckpointError, match=r"array params/\S+ is float32\[.*\], expected float32\["):
        starting_point(_config(imported, dataclasses.replace(POLICY, encoder_size=16)))


def test_a_policy_to_start_from_that_is_not_there_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--run.start_from", str(tmp_path / "nosuch")]
    assert main(["train", "--recipe", "tiny", "--run", str(tmp_path / "run"), *options]) == 2
    assert f"there is no checkpoint {tmp_path / 'nosuch'}" in capsys.readouterr().err


LEAF = "params/Dense_0/bias"  # of 7 numbers


@pytest.mark.parametrize(
    ("leaf", "message"),
    [
        (None, f"leaf {LEAF} is missing (1 of 48 are)"),
        (np.zeros(9, np.float32), f"leaf {LEAF} is [9], expected [7]"),
        (np.zeros(7, np.float16), f"{LEAF} is F16; only F32 is read"),
        (np.full(7, np.inf, np.float32), f"leaf {LEAF} holds a number that is not finite"),
    ],
)
def test_a_leaf_that_is_wrong_ends_the_command(
    leaf: np.ndarray | None,
    message: str,
    package_policy: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    leaves = read_safetensors(package_policy / "params.safetensors")
    del leaves[LEAF]
    if leaf is not None:
        leaves[LEAF] = leaf
    write_policy(tmp_path / "policy", leaves, SMALL | {"legacy_entity_id": False})
    _refused(tmp_path / "policy", tmp_path, message, capsys)


def test_an_extra_leaf_ends_the_command(
    package_policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "params/GeneralActorCriticRNN_0/ScannedRNN_0/GRUCell_0/hn/kernel"
    leaves = read_safetensors(package_policy / "params.safetensors") | {name: np.zeros((2, 2), np.float32)}
    write_policy(tmp_path / "policy", leaves, SMALL | {"legacy_entity_id": False})
    _refused(tmp_path / "policy", tmp_path, f"leaf {name} is not expected (1 are not)", capsys)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"activation": "relu"}, "activation is 'relu'; only policies with 'tanh' can be imported"),
        ({"critic_width": 16}, "critic_width is 16, but actor and critic of one size"),
        ({"num_heads": 6}, "num_heads is 6; it must be a multiple of 4"),
        ({"legacy_entity_id": None}, "does not say legacy_entity_id; give --legacy-entity-id"),
    ],
)
def test_an_option_that_cannot_be_imported_is_named(
    option: dict, message: str, package_policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    leaves = read_safetensors(package_policy / "params.safetensors")
    write_policy(tmp_path / "policy", leaves, SMALL | {"legacy_entity_id": False} | option)
    _refused(tmp_path / "policy", tmp_path, message, capsys)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"BZh91AY&SY", "is a pickle or an archive, which could run anything when it is read"),
        (b"\x80\x04\x95\x0b", "is a pickle or an archive, which could run anything when it is read"),
        (b"short", "has 5 bytes: it is no safetensors file"),
        ((1 << 40).to_bytes(8, "little") + b"{}", "is cut or no safetensors file"),
        ((2).to_bytes(8, "little") + b"[]", "its header cannot be read"),
        ((11).to_bytes(8, "little") + b'{"a":{"b":1', "its header cannot be read"),
        ((9).to_bytes(8, "little") + b'{"a":{}} ', "the entry of a cannot be read"),
    ],
)
def test_a_file_that_is_no_safetensors_file_ends_the_command(
    content: bytes, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "model.safetensors").write_bytes(content)
    _refused(tmp_path / "model.safetensors", tmp_path, message, capsys)


UNREADABLE = "the entry of a cannot be read"


@pytest.mark.parametrize(
    ("shape", "offsets", "message"),
    [
        ([2**62, 0], [0, 0], "a has a shape that no array has"),
        ([1] * 65, [0, 4], "a has a shape that no array has"),
        ([1], [0.0, 4.0], UNREADABLE),
        ([1], [False, 4], UNREADABLE),
        ([1.5], [0, 4], UNREADABLE),
        ([True], [0, 4], UNREADABLE),
        (["1"], [0, 4], UNREADABLE),
        ("1", [0, 4], UNREADABLE),
        (1, [0, 4], UNREADABLE),
        ([-1], [0, 4], "does not lie in bytes 0 to 4"),
        ([1], [0, 8], "does not lie in bytes 0 to 8"),
        ([1], [0, 2**62], "does not lie in bytes"),
        ([1], [0], UNREADABLE),
    ],
)
def test_a_shape_or_an_offset_that_no_array_has_ends_the_command(
    shape: object, offsets: object, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = _safetensors(tmp_path, {"a": {"dtype": "F32", "shape": shape, "data_offsets": offsets}})
    _refused(source, tmp_path, message, capsys)


def test_names_of_tensors_are_shown_short_and_printable(tmp_path: Path) -> None:
    name = "\x1b[2J" + "x" * 100_000
    good = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
    changes = ({"dtype": name}, {"shape": [1] * 100_000}, {"shape": [2] * 1_000}, {"data_offsets": None})
    for number, change in enumerate(changes):
        source = _safetensors(tmp_path / str(number), {name: good | change})
        with pytest.raises(SafetensorsError) as caught:
            read_safetensors(source)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 600


def _safetensors(folder: Path, header: dict) -> Path:
    """Write a file with this header and four bytes of data; return its path."""
    content = json.dumps(header).encode()
    folder.mkdir(exist_ok=True)
    path = folder / "model.safetensors"
    path.write_bytes(len(content).to_bytes(8, "little") + content + bytes(4))
    return path


def test_a_file_that_is_cut_ends_the_command(
    package_policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "params.safetensors").write_bytes((package_policy / "params.safetensors").read_bytes()[:-8])
    _refused(tmp_path, tmp_path, "is cut or damaged", capsys)


def test_a_place_that_is_taken_and_a_source_that_is_not_there_are_one_line(
    imported: Path, package_policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["import-checkpoint", str(package_policy), "--out", str(imported)]) == 2
    assert f"{imported} exists; choose another --out" in capsys.readouterr().err
    _refused(tmp_path / "nosuch", tmp_path, "there is no", capsys)


def _refused(source: Path, folder: Path, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["import-checkpoint", str(source), "--out", str(folder / "imported")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (folder / "imported").exists()
