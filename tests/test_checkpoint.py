"""Checkpoints: exact, atomic, and never silently wrong."""

import resource
from pathlib import Path

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax.learn import networks, normalizer
from dcc_jax.learn.rollout import Policy
from dcc_jax.training import checkpoint


@flax.struct.dataclass
class State:
    layers: networks.Mlp
    key: jax.Array
    count: jax.Array
    nothing: jax.Array | None


def _state(seed: int) -> State:
    layers = networks.init_mlp(jax.random.key(seed), (40, 60, 3))
    return State(layers, jax.random.key(seed + 100), jnp.array(seed, jnp.int32), None)


def _equal(a: State, b: State) -> bool:
    left, right = checkpoint.to_arrays(a), checkpoint.to_arrays(b)
    return left.keys() == right.keys() and all(
        left[k].dtype == right[k].dtype and np.array_equal(left[k], right[k])
        for k in left
    )


def _silent(message: str) -> None:
    raise AssertionError(message)


def _flip_a_byte(path: Path) -> Path:
    largest = max(
        (f for f in path.rglob("*") if f.is_file()), key=lambda f: f.stat().st_size
    )
    content = bytearray(largest.read_bytes())
    content[len(content) // 2] ^= 1
    largest.write_bytes(bytes(content))
    return largest


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    for update in (2, 4):
        checkpoint.save(tmp_path, update, _state(update), keep=3)
    return tmp_path


def test_newest_checkpoint_comes_back_bit_for_bit(run_dir):
    found = checkpoint.restore_latest(run_dir, _state(0), _silent)
    assert found is not None and found[0] == 4
    assert _equal(found[1], _state(4))
    same = jax.random.uniform(found[1].key) == jax.random.uniform(_state(4).key)
    assert bool(same)


def test_no_checkpoint_is_no_error(tmp_path):
    assert checkpoint.restore_latest(tmp_path, _state(0), _silent) is None


def test_flipped_byte_is_named_and_the_one_before_is_used(run_dir):
    _flip_a_byte(run_dir / "checkpoints" / "000000004")
    said: list[str] = []
    found = checkpoint.restore_latest(run_dir, _state(0), said.append)
    assert found is not None and found[0] == 2
    assert _equal(found[1], _state(2))
    assert len(said) == 1
    assert "skipping damaged checkpoint" in said[0] and "000000004" in said[0]


def test_array_that_is_not_what_was_written_is_named(run_dir, monkeypatch):
    # Damage that the storage library does not notice.
    digests = checkpoint._digests

    def of_another_key(arrays):
        return digests(arrays | {"key": arrays["key"] + 1})

    monkeypatch.setattr(checkpoint, "_digests", of_another_key)
    checkpoint.save(run_dir, 6, _state(6), keep=3)
    monkeypatch.undo()
    said: list[str] = []
    found = checkpoint.restore_latest(run_dir, _state(0), said.append)
    assert found is not None and found[0] == 4
    assert len(said) == 1 and "000000006: key is not what was written" in said[0]


def test_checkpoint_of_an_older_version_is_refused_in_one_line(run_dir):
    (run_dir / "checkpoints" / "000000004.sha256").write_text("{}")
    with pytest.raises(
        checkpoint.CheckpointError, match="000000004 was written by an older"
    ):
        checkpoint.restore_latest(run_dir, _state(0), _silent)


def test_policy_of_another_meaning_is_refused(tmp_path, monkeypatch):
    with monkeypatch.context() as earlier:
        earlier.setattr(checkpoint, "_POLICY_FORMAT", checkpoint._POLICY_FORMAT - 1)
        checkpoint.save_policy(tmp_path, _policy())
        checkpoint.load_policy(tmp_path)
    with pytest.raises(
        ValueError, match=r"policy\.npz was written by an older version"
    ):
        checkpoint.load_policy(tmp_path)


def test_state_of_another_meaning_is_refused(run_dir, monkeypatch):
    with monkeypatch.context() as earlier:
        earlier.setattr(checkpoint, "_STATE_FORMAT", checkpoint._STATE_FORMAT - 1)
        checkpoint.save(run_dir, 6, _state(6), keep=3)
        assert checkpoint.restore_latest(run_dir, _state(0), _silent) is not None
    with pytest.raises(
        checkpoint.CheckpointError, match="000000006 was written by an older"
    ):
        checkpoint.restore_latest(run_dir, _state(0), _silent)


def test_update_is_saved_although_a_later_one_is_damaged(run_dir):
    _flip_a_byte(run_dir / "checkpoints" / "000000004")
    checkpoint.save(run_dir, 3, _state(3), keep=3)
    said: list[str] = []
    found = checkpoint.restore_latest(run_dir, _state(0), said.append)
    assert found is not None and found[0] == 3 and len(said) == 1
    checkpoint.save(run_dir, 4, _state(4), keep=3)
    found = checkpoint.restore_latest(run_dir, _state(0), _silent)
    assert found is not None and found[0] == 4


def test_missing_file_is_damage_too(run_dir):
    largest = _flip_a_byte(run_dir / "checkpoints" / "000000004")
    largest.unlink()
    said: list[str] = []
    found = checkpoint.restore_latest(run_dir, _state(0), said.append)
    assert found is not None and found[0] == 2 and len(said) == 1


def test_all_damaged_is_an_error(run_dir):
    for update in (2, 4):
        _flip_a_byte(run_dir / "checkpoints" / f"{update:09d}")
    with pytest.raises(checkpoint.CheckpointError, match="every checkpoint"):
        checkpoint.restore_latest(run_dir, _state(0), lambda _: None)


def test_write_that_a_kill_cut_short_does_not_count(run_dir):
    # What orbax calls a directory until it is whole.
    folder = run_dir / "checkpoints"
    folder.joinpath("000000004").rename(folder / "000000004.orbax-checkpoint-tmp")
    found = checkpoint.restore_latest(run_dir, _state(0), _silent)
    assert found is not None and found[0] == 2
    checkpoint.save(run_dir, 4, _state(4), keep=3)
    assert checkpoint.available(run_dir) == [4, 2]


def test_only_the_last_few_stay(run_dir):
    checkpoint.save(run_dir, 6, _state(6), keep=2)
    assert checkpoint.available(run_dir) == [6, 4]
    assert not (run_dir / "checkpoints" / "000000002").exists()


def test_full_disk_leaves_the_earlier_checkpoints_intact(run_dir):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        with pytest.raises(checkpoint.CheckpointError, match="earlier ones are intact"):
            checkpoint.save(run_dir, 6, _state(6), keep=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert checkpoint.available(run_dir) == [4, 2]
    left = sorted(p.name for p in (run_dir / "checkpoints").glob("000000006*"))
    assert left == []
    found = checkpoint.restore_latest(run_dir, _state(0), _silent)
    assert found is not None and _equal(found[1], _state(4))


def test_another_network_size_is_refused_by_name(run_dir):
    other = _state(0).replace(layers=networks.init_mlp(jax.random.key(0), (40, 50, 3)))
    with pytest.raises(ValueError, match=r"layers\.layers\.0\.(bias|kernel) has shape"):
        checkpoint.restore_latest(run_dir, other, _silent)
    deeper = _state(0).replace(
        layers=networks.init_mlp(jax.random.key(0), (40, 60, 60, 3))
    )
    with pytest.raises(ValueError, match=r"does not fit this run: layers\.layers\.2"):
        checkpoint.restore_latest(run_dir, deeper, _silent)


def _policy() -> Policy:
    return Policy(
        params=networks.init_mlp(jax.random.key(0), (5, 8, 8, 2), activation="elu"),
        normalizer=normalizer.moments(jax.random.normal(jax.random.key(1), (20, 5))),
    )


def test_exported_policy_acts_as_before(tmp_path):
    policy = _policy()
    checkpoint.save_policy(tmp_path, policy)
    obs = jax.random.normal(jax.random.key(2), (3, 5))
    np.testing.assert_array_equal(
        checkpoint.load_policy(tmp_path).mean(obs), policy.mean(obs)
    )


def test_damaged_or_missing_policy_is_one_line(tmp_path):
    with pytest.raises(ValueError, match=r"holds no policy\.npz"):
        checkpoint.load_policy(tmp_path)
    path = checkpoint.save_policy(tmp_path, _policy())
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ValueError, match="is damaged"):
        checkpoint.load_policy(tmp_path)


def test_policy_of_numbers_that_are_not_finite_is_refused(tmp_path):
    policy = _policy()
    broken = jax.tree.map(lambda leaf: leaf * np.nan, policy.params)
    checkpoint.save_policy(tmp_path, policy.replace(params=broken))
    with pytest.raises(ValueError, match="is damaged: some of its numbers are not"):
        checkpoint.load_policy(tmp_path)


def test_pickled_policy_is_refused(tmp_path):
    np.savez(tmp_path / "policy.npz", payload=np.array([object()]))
    with pytest.raises(ValueError, match="is damaged"):
        checkpoint.load_policy(tmp_path)
