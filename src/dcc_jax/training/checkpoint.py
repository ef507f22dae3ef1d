"""Whole runs on disk, and policies small enough to ship. No pickle is ever loaded.

A checkpoint is `checkpoints/000000050/`, which orbax's `CheckpointManager` writes
elsewhere and renames into place when it is whole. It has two items: `state`, every
array by its name and the format, and `digests`, a SHA-256 of every array. What orbax
reads is compared with them, so that a damaged checkpoint is never resumed from.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from dcc_jax.learn.networks import ACTIVATIONS, Activation, Layer, Mlp
from dcc_jax.learn.normalizer import Normalizer
from dcc_jax.learn.rollout import Policy

_FOLDER = "checkpoints"
_DIGITS = 9  # of an update in the name of its checkpoint
_STATE_FORMAT = 6
_POLICY_FORMAT = 3
"""Raised when their arrays come to mean something else. 3: discriminator and policy see
velocities. 4: a state holds the averaged policy. 5: how soles slide is seen. 6: a
reference sways."""


class CheckpointError(RuntimeError):
    """A checkpoint could not be written, or none can be read."""


def save(run_dir: Path, update: int, state: Any, keep: int) -> Path:
    """Writes a checkpoint, then removes all but the newest `keep`.

    Args:
        run_dir: of the run.
        update: how many updates the state has seen; names the checkpoint.
        state: any pytree of arrays and random keys.
        keep: checkpoints that stay.

    Raises:
        CheckpointError: it could not be written; the earlier ones are as they were.
    """
    path = _path(run_dir, update)
    arrays = to_arrays(state) | {"format": np.array(_STATE_FORMAT)}
    items = ocp.args.Composite(
        state=ocp.args.StandardSave(arrays),
        digests=ocp.args.JsonSave(_digests(arrays)),
    )
    try:
        with _manager(run_dir, keep) as manager:
            if path.exists():
                manager.delete(update)
            # By force: a later one that is damaged would make orbax pass this one over.
            manager.save(update, args=items, force=True)
    # orbax raises whatever its storage library does: OSError, ValueError, its own.
    except Exception as error:
        _discard(path)
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise CheckpointError(
            f"cannot write checkpoint {path}: {reason[0]}; earlier ones are intact"
        ) from error
    return path


def available(run_dir: Path) -> list[int]:
    """Updates of the checkpoints that were finished, newest first."""
    found = (run_dir / _FOLDER).glob("*")
    return sorted((int(p.name) for p in found if p.name.isdecimal()), reverse=True)


def restore_latest(
    run_dir: Path, template: Any, say: Callable[[str], None]
) -> tuple[int, Any] | None:
    """The newest readable checkpoint as (update, state), or None where there is none.

    Args:
        run_dir: of the run.
        template: a state (or its shapes) of the same structure.
        say: told about every damaged checkpoint that is passed over.

    Raises:
        CheckpointError: there are checkpoints, and all are damaged, or an older version
            of this package wrote the newest.
        ValueError: the state has another shape than the template.
    """
    updates = available(run_dir)
    for update in updates:
        path = _path(run_dir, update)
        if path.with_name(f"{path.name}.sha256").exists():
            raise CheckpointError(_older(path))
        try:
            arrays = _read(run_dir, update)
        except CheckpointError as error:
            say(f"skipping damaged checkpoint {path}: {error}")
            continue
        if arrays.pop("format", None) != _STATE_FORMAT:
            raise CheckpointError(_older(path))
        return update, from_arrays(arrays, template)
    if updates:
        raise CheckpointError(f"every checkpoint in {run_dir / _FOLDER} is damaged")
    return None


def to_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Every leaf as a host array by its path, random keys as their data.

    Leaves of no elements are left out: orbax refuses them.
    """
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {_name(path): np.asarray(_raw(leaf)) for path, leaf in leaves if leaf.size}


def from_arrays(arrays: dict[str, np.ndarray], template: Any) -> Any:
    """The inverse of `to_arrays`; leaves are host arrays and random keys.

    Raises:
        ValueError: names or shapes differ from the template's.
    """
    leaves, tree = jax.tree_util.tree_flatten_with_path(template)
    named = [(_name(path), leaf) for path, leaf in leaves]
    missing = sorted({name for name, leaf in named if leaf.size} ^ arrays.keys())
    if missing:
        raise ValueError(f"the checkpoint does not fit this run: {missing[0]}")
    restored = [
        _restored(name, arrays[name], leaf)
        if leaf.size
        else np.zeros(leaf.shape, leaf.dtype)
        for name, leaf in named
    ]
    return jax.tree_util.tree_unflatten(tree, restored)


def save_policy(directory: Path, policy: Policy) -> Path:
    """Writes `policy.npz`, a few hundred kB, replacing an older one atomically."""
    path = directory / "policy.npz"
    partial = directory / "policy.partial.npz"
    arrays = to_arrays(policy) | {
        "activation": np.array(policy.params.activation),
        "format": np.array(_POLICY_FORMAT),
    }
    np.savez(partial, **arrays)  # pyright: ignore[reportArgumentType]
    os.replace(partial, path)
    return path


def load_policy(directory: Path) -> Policy:
    """The policy in a run directory or one that ships with the package.

    Raises:
        ValueError: there is no `policy.npz`, it is damaged, or an older version of this
            package wrote it.
    """
    path = Path(directory) / "policy.npz"
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        count = sum(name.endswith(".kernel") for name in arrays)
        normalizer = {
            field: arrays[f"normalizer.{field}"]
            for field in Normalizer.__dataclass_fields__
        }
        layers = tuple(
            Layer(
                kernel=arrays[f"params.layers.{i}.kernel"],
                bias=arrays[f"params.layers.{i}.bias"],
            )
            for i in range(count)
        )
        policy = Policy(
            params=Mlp(layers=layers, activation=_activation(arrays)),
            normalizer=Normalizer(**normalizer),
        )
    except FileNotFoundError:
        raise ValueError(f"{directory} holds no policy.npz") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is damaged: {error}") from None
    if arrays.get("format") != _POLICY_FORMAT:
        raise ValueError(_older(path))
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(policy)):
        raise ValueError(f"{path} is damaged: some of its numbers are not finite")
    return policy


def write_atomically(path: Path, content: bytes) -> None:
    """Replaces a file at once: a reader sees the old content or the new, never half."""
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def _activation(arrays: dict[str, np.ndarray]) -> Activation:
    name = str(arrays["activation"])
    if name not in ACTIVATIONS:
        raise ValueError(f"unknown activation {name!r}")
    return cast(Activation, name)


def _manager(run_dir: Path, keep: int | None = None) -> ocp.CheckpointManager:
    mine = jax.process_index()
    # The first of several processes writes, and each reads, without the others.
    alone = ocp.options.MultiprocessingOptions(
        primary_host=mine,
        active_processes={mine},
        barrier_sync_key_prefix=f"process-{mine}",
    )
    (run_dir / _FOLDER).mkdir(parents=True, exist_ok=True)
    options = ocp.CheckpointManagerOptions(
        max_to_keep=keep,
        step_format_fixed_length=_DIGITS,
        enable_async_checkpointing=False,
        multiprocessing_options=alone,
        create=False,
    )
    return ocp.CheckpointManager((run_dir / _FOLDER).absolute(), options=options)


def _path(run_dir: Path, update: int) -> Path:
    return run_dir / _FOLDER / f"{update:0{_DIGITS}d}"


def _read(run_dir: Path, update: int) -> dict[str, np.ndarray]:
    items = ocp.args.Composite(
        state=ocp.args.StandardRestore(), digests=ocp.args.JsonRestore()
    )
    try:
        with _manager(run_dir) as manager:
            found = manager.restore(update, args=items)
        arrays, expected = found.state, found.digests
        actual = _digests(arrays)
    # As in `save`: there is no telling what damage makes it raise.
    except Exception as error:
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise CheckpointError(f"orbax cannot read it: {reason[0][:200]}") from error
    names = expected.keys() | actual.keys()
    changed = sorted(k for k in names if expected.get(k) != actual.get(k))
    if changed:
        raise CheckpointError(f"{changed[0]} is not what was written")
    return arrays


def _digests(arrays: dict[str, np.ndarray]) -> dict[str, str]:
    """SHA-256 of type, shape and content of every array."""
    return {
        name: hashlib.sha256(
            f"{array.dtype}{array.shape}".encode() + array.tobytes()
        ).hexdigest()
        for name, array in arrays.items()
    }


def _older(path: Path) -> str:
    return (
        f"{path} was written by an older version of dcc_jax, whose runs hold other "
        "numbers; train it again"
    )


def _discard(path: Path) -> None:
    """Clears away what a failed write left: orbax does so at no later time either."""
    for left in path.parent.glob(f"{path.name}*"):
        shutil.rmtree(left, ignore_errors=True)


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _raw(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _restored(name: str, array: np.ndarray, like: Any) -> Any:
    if _is_key(like):
        return jax.random.wrap_key_data(jnp.asarray(array))
    if array.shape != like.shape:
        raise ValueError(
            f"the checkpoint does not fit this run: {name} has shape "
            f"{array.shape}, not {like.shape}"
        )
    return array.astype(like.dtype, copy=False)
