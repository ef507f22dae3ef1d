"""The heart: one control step, how it is judged, and what keeps a run going."""

from __future__ import annotations

import copy
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax import quat
from dcc_jax.character import BODIES, CONTROL_DT, Character, asset_path
from dcc_jax.control import pd
from dcc_jax.control.controller import Displacement
from dcc_jax.env import features, mechanics
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.environment import Environment
from dcc_jax.env.features import FEATURE_SIZE
from dcc_jax.env.observation import ALPHA_ENTRY
from dcc_jax.env.outcome import FallTest
from dcc_jax.env.state import EnvState
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.reference import make_references
from dcc_jax.tasks.push import Push

CONFIG = EnvConfig(alpha=0.1, alpha_max=0.5, episode_seconds=2.0)
SEED = 3


def make(character: Character, config: EnvConfig) -> Environment:
    clip = load_clip(asset_path("motions/stand.npz"))
    return Environment(Push(), character, make_references([clip]), config)


@pytest.fixture(scope="module")
def environment(character: Character) -> Environment:
    return make(character, CONFIG)


@pytest.fixture(scope="module")
def start(environment: Environment) -> EnvState:
    return jax.jit(environment.reset)(jax.random.key(0))


@pytest.fixture(scope="module")
def step(environment: Environment):
    """(state) -> the state after a control step of the zero action."""
    action = jnp.zeros(environment.action_size)
    return jax.jit(lambda state: environment.step(jax.random.key(SEED), state, action))


def moved(state: EnvState, **entries: float) -> EnvState:
    """The state with entries of qpos changed: x, y, z of the root."""
    qpos = state.body.qpos
    for name, value in entries.items():
        qpos = qpos.at["xyz".index(name)].set(value)
    return dataclasses.replace(state, body=dataclasses.replace(state.body, qpos=qpos))


def test_a_standing_character_goes_on(start, step):
    after = step(start)
    assert not after.terminated and not after.truncated and not after.nan
    np.testing.assert_allclose(after.time, CONTROL_DT, rtol=1e-5)
    np.testing.assert_array_equal(after.previous_features, start.features)


def test_who_lies_has_fallen(start, step):
    """On the back, soles in the air: nothing throws it up again."""
    lying = jnp.array([np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0])
    qpos = start.body.qpos.at[2].set(0.3).at[3:7].set(lying)
    body = dataclasses.replace(start.body, qpos=qpos)
    assert step(dataclasses.replace(start, body=body)).terminated


def test_a_hand_on_the_ground_is_a_fall_though_the_pelvis_is_high(environment):
    upright = jnp.asarray(environment.scene.model.qpos0[:55], jnp.float32)
    upside_down = upright.at[3:7].set(jnp.array([0.0, 0.0, 1.0, 0.0])).at[2].set(0.7)
    raised = jnp.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])  # about x
    handstand = upside_down.at[15:19].set(raised)  # the left shoulder
    fallen = jax.jit(
        lambda q, ground: environment.fallen(environment.kinematics, q, ground)
    )
    assert not fallen(upright, 0.0)
    assert not fallen(upside_down, 0.0)
    assert fallen(handstand, 0.0)
    # It is the height above the ground that counts.
    assert not fallen(handstand, -1.0)


def test_the_time_runs_out(start, step):
    late = dataclasses.replace(start, time=jnp.array(2.0 - 2.0 * CONTROL_DT))
    assert not step(late).truncated
    assert step(dataclasses.replace(late, time=late.time + CONTROL_DT)).truncated
    # The time is of whole control steps, whatever float32 lost on the way.
    lost = dataclasses.replace(late, time=late.time + CONTROL_DT - 1e-3)
    assert step(lost).truncated and step(lost).time == 2.0


def test_a_clip_that_goes_to_the_floor_is_no_fall(character):
    """A pose of the clip has a hand at 3 cm: a hand may be lower by 5 cm, to -2 cm."""
    clip = load_clip(asset_path("motions/stand.npz"))
    hand = BODIES.index("left_hand")
    skeleton = features.skeleton()
    height = float(features.body_poses(skeleton, clip.qpos[0])[0][hand, 2])
    qpos = clip.qpos.copy()
    qpos[:, 2] += 0.03 - height
    low = dataclasses.replace(clip, qpos=qpos)
    test, usual = (FallTest.of(CONFIG, make_references([c])) for c in (low, clip))
    assert test.clearance < 0.03 - 0.049
    assert usual.clearance == CONFIG.limb_clearance


def test_a_number_that_is_not_finite_ends_the_episode_and_goes_no_further(start, step):
    qvel = start.body.qvel.at[10].set(jnp.nan)
    broken = dataclasses.replace(start, body=dataclasses.replace(start.body, qvel=qvel))
    after = step(broken)
    assert after.nan and after.terminated and not after.truncated
    # The state before the step is kept, the number that was broken already with it.
    np.testing.assert_array_equal(after.body.qpos, start.body.qpos)
    assert np.isfinite(after.obs).all() and np.isfinite(after.features).all()


@pytest.mark.parametrize(("x", "u"), [(0.0, 0.0), (0.3, 0.0), (0.3, 0.3)])
def test_r_p_is_of_the_root_against_its_target_and_u(environment, start, step, x, u):
    """Eq. 14 with its weights written out: a displaced root may be where u says."""
    displacement = dataclasses.replace(
        start.displacement, u=start.displacement.u.at[0].set(u)
    )
    state = dataclasses.replace(
        moved(start, x=float(start.start.position[0]) + x), displacement=displacement
    )
    after = step(state)
    q = np.asarray(after.body.qpos[:2]) - np.asarray(start.start.position)
    p = q - np.asarray(after.displacement.u[:2])
    v = np.asarray(after.body.qvel[:2]) - np.asarray(after.displacement.ud[:2])
    expected = 0.7 * np.exp(-0.5 * p @ p) + 0.3 * np.exp(-1.0 * v @ v)
    np.testing.assert_allclose(after.r_p, expected, rtol=1e-4)
    if x != u:
        assert after.r_p < 1.0 - 0.02


@pytest.mark.parametrize("displaced", [True, False])
def test_the_pd_target_is_displaced_unless_it_is_switched_off(
    environment, start, displaced
):
    coords = environment.kinematics.coords
    environment = _like(environment, displace_target=displaced)
    turn = jnp.zeros(Character.nv).at[20].set(0.4)
    state = dataclasses.replace(
        start,
        displacement=dataclasses.replace(
            start.displacement, u=quat.exp_map(coords, turn)
        ),
    )
    action = jnp.zeros(environment.action_size)
    carry, inputs = jax.jit(
        lambda state: environment.begin(jax.random.key(SEED), state, action)
    )(state)
    scene = environment.scene
    q, qd = (
        scene.character_qpos(state.body.qpos),
        scene.character_qvel(state.body.qvel),
    )
    wanted = inputs.pose
    if displaced:
        wanted = quat.oplus(coords, wanted, state.displacement.u)
    expected = pd.torque(scene.character, q, qd, wanted, scene.timestep)
    tau = environment.side.torque(carry, inputs)
    np.testing.assert_allclose(tau, expected, rtol=1e-5)
    other = pd.torque(scene.character, q, qd, inputs.pose, scene.timestep)
    assert np.allclose(tau, other) != displaced, "u must be large enough to be seen"


def _like(environment: Environment, **changes) -> Environment:
    twin = copy.copy(environment)
    twin.config = dataclasses.replace(environment.config, **changes)
    return twin


def test_alpha_is_drawn_from_its_range_and_observed(environment):
    states = jax.jit(jax.vmap(environment.reset))(
        jax.random.split(jax.random.key(SEED), 64)
    )
    alpha = np.asarray(states.alpha)
    assert alpha.min() >= 0.1 and alpha.max() <= 0.5 and np.ptp(alpha) > 0.3
    np.testing.assert_array_equal(states.obs[:, ALPHA_ENTRY], alpha)


@pytest.mark.parametrize("pd_yields", [True, False])
def test_the_discriminator_sees_a_pose_without_all_that_forces_made_it_yield(
    environment, start, pd_yields, monkeypatch
):
    """Also what PD gives way by, of which u is a share alone (Eq. (6)), if it does."""
    monkeypatch.setattr(type(environment.task), "pd_yields", pd_yields)
    rng = np.random.default_rng(0)
    coords, scene = environment.kinematics.coords, environment.scene
    y = 0.2 * rng.normal(size=coords.nv).astype(np.float32)
    y[[2, 3, 4, 5]] = 0.0  # what of the root is not displaced
    whole = quat.exp_map(coords, jnp.asarray(y))
    u = quat.exp_map(coords, jnp.asarray(0.5 * y))
    gone = whole if pd_yields else u
    slid = start.q_previous.at[0].add(0.003)

    def observed(u, y, away):
        q = scene.character_qpos(start.body.qpos)
        qpos = start.body.qpos.at[scene.qpos_adr : scene.qpos_adr + coords.nq].set(
            quat.oplus(coords, q, away)
        )
        return environment.observed(
            dataclasses.replace(
                start,
                body=dataclasses.replace(start.body, qpos=qpos),
                q_previous=quat.oplus(coords, slid, away),
                displacement=dataclasses.replace(start.displacement, u=u, y=y),
                u_previous=u,
                yield_previous=environment.yielded(Displacement(u=u, ud=y, y=y, yd=y)),
            )
        )

    rest = quat.identity(coords)
    at_rest = observed(rest, jnp.zeros(coords.nv), rest)
    yielded = observed(u, jnp.asarray(y), gone)
    np.testing.assert_allclose(
        yielded.features[:FEATURE_SIZE], at_rest.features[:FEATURE_SIZE], atol=2e-5
    )
    # Soles slide where the character is, not where it would be.
    now, before = scene.character_qpos(yielded.body.qpos), yielded.q_previous
    np.testing.assert_allclose(
        yielded.features[FEATURE_SIZE:],
        mechanics.sliding(environment.mechanics, now, before),
        atol=1e-6,
    )
    assert np.abs(yielded.features - at_rest.features)[FEATURE_SIZE:].min() > 0.03
    # The policy's own numbers have u taken off, as in the paper.
    apart = np.abs(yielded.obs[:270] - at_rest.obs[:270]).max()
    assert apart > 0.01 if pd_yields else apart < 1e-3


def test_task_that_observes_another_number_of_numbers_is_told(
    environment, start, monkeypatch
):
    monkeypatch.setattr(Push, "state_size", 7)
    with pytest.raises(ValueError, match=r"Push\.observe gives \[6\] numbers, its st"):
        environment.observed(start)


def test_discriminator_sees_heights_above_what_the_character_stands_on(
    environment, start, monkeypatch
):
    height = environment.scene.qpos_adr + 2
    up = dataclasses.replace(
        start,
        body=dataclasses.replace(start.body, qpos=start.body.qpos.at[height].add(0.3)),
        q_previous=start.q_previous.at[2].add(0.1),
        ground_previous=jnp.float32(0.1),
    )
    monkeypatch.setattr(Push, "ground_height", lambda *_: jnp.float32(0.3))
    seen = environment.observed(up)
    np.testing.assert_allclose(seen.features, start.features, atol=1e-4)
    # The policy sees where it is in the world.
    assert np.abs(seen.obs[:270] - start.obs[:270]).max() > 0.29
