"""A box at known momentum against the character, with nothing else around."""

from __future__ import annotations

import dataclasses
from functools import partial

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import config, physics, tasks
from dcc_jax.character import CONTROL_DT, asset_path, compose_scene, load_character
from dcc_jax.motion import paths
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.reference import References, make_references
from dcc_jax.tasks import chicken_fight
from dcc_jax.tasks.chicken_fight import HALF_SIZE, LONG, ChickenFight

TASK = ChickenFight()
MASS = 36.0  # kg, the light player
SIDES = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
STEPS = 200


@pytest.fixture(scope="module")
def scene() -> physics.Scene:
    """The light player and its box in empty space."""
    character = load_character(MASS)
    model = compose_scene(character, floor=False, extend=TASK.extend)
    model.opt.gravity[:] = 0.0
    return physics.make_scene(model, character)


@pytest.fixture(scope="module")
def reference():
    references = hops()
    return references.state_at(0, 3.0)


@pytest.fixture(scope="module")
def began(scene, reference):
    """The task's state and the body at a reset, at rest, an attack under way."""
    state, qpos, qvel = TASK.reset(jax.random.key(0), scene, reference)
    state = dataclasses.replace(state, coming=jnp.ones((), bool))
    return state, physics.initial_state(scene, qpos, jnp.zeros_like(qvel))


@pytest.fixture(scope="module")
def attacks(scene, began):
    """The bodies of 200 attacks, as they begin."""
    state, body = began
    due = dataclasses.replace(state, next_attack=jnp.zeros(()))
    keys = jax.random.split(jax.random.key(1), 200)
    step = jax.vmap(lambda key: TASK.control_step(key, scene, due, body))
    return jax.tree.map(np.array, jax.jit(step)(keys))


@pytest.fixture(scope="module")
def bumps(scene, began):
    """Boxes at 1 m/s from all SIDES: states, what was noted, forces in every step."""
    state, body = began

    def run(side):
        away = jnp.stack([jnp.cos(side), jnp.sin(side)])
        root = body.qpos[scene.qpos_adr : scene.qpos_adr + 2]
        adr, dof = box(scene)
        place = jnp.append(root + 0.7 * away, side)
        start = dataclasses.replace(
            body,
            qpos=body.qpos.at[adr : adr + 3].set(place),
            qvel=body.qvel.at[dof : dof + 2].set(-away),
        )

        def step(carry, _):
            noted, body = carry
            kin = physics.kinematics(scene, body)
            nothing = jnp.zeros(scene.model.nv)
            solution = physics.solve(scene, kin, body, nothing)
            noted, forces = TASK.forces(scene, noted, kin, solution, jnp.zeros(36))
            body = physics.integrate(scene, body, solution)
            return (noted, body), (noted, body, forces)

        return jax.lax.scan(step, (state, start), None, length=STEPS)[1]

    compiled = jax.jit(jax.vmap(chex.assert_max_traces(n=1)(run)))
    return jax.tree.map(np.array, compiled(jnp.asarray(SIDES, jnp.float32)))


def hops(names=TASK.clips) -> References:
    return make_references(
        [load_clip(asset_path(f"motions/{name}.npz")) for name in names]
    )


def box(scene: physics.Scene) -> tuple[int, int]:
    joint = scene.model.joint("box")
    return int(joint.qposadr[0]), int(joint.dofadr[0])


def momentum(scene: physics.Scene, body: physics.State, index) -> np.ndarray:
    """Of character and box [2, 3] N s, by C MuJoCo."""
    data = mujoco.MjData(scene.model)
    data.qpos[:], data.qvel[:] = body.qpos[index], body.qvel[index]
    mujoco.mj_forward(scene.model, data)
    mujoco.mj_subtreeVel(scene.model, data)
    ids = [scene.body("pelvis"), scene.body("box")]
    return scene.model.body_subtreemass[ids, None] * data.subtree_linvel[ids]


@pytest.mark.parametrize("mass", [36.0, 65.0, 85.0])
def test_the_box_is_as_heavy_as_the_character(mass):
    model = compose_scene(load_character(mass), extend=TASK.extend)
    np.testing.assert_allclose(model.body("box").mass, mass, rtol=1e-6)
    np.testing.assert_allclose(model.geom("box").size, HALF_SIZE)
    np.testing.assert_allclose(
        model.body_subtreemass[model.body("pelvis").id], mass, rtol=1e-6
    )


def test_impulse_read_out_is_the_momentum_the_box_loses(scene, bumps):
    noted, body, forces = bumps
    fed = forces.force_w.sum(axis=2).sum(axis=1) * scene.timestep
    np.testing.assert_allclose(noted.impulse[:, -1], fed, rtol=1e-3, atol=0.02)
    _, dof = box(scene)
    for i, side in enumerate(SIDES):
        at_first = -MASS * np.array([np.cos(side), np.sin(side)])
        lost = at_first - MASS * body.qvel[i, -1, dof : dof + 2]
        assert np.linalg.norm(lost) > 0.3 * MASS
        np.testing.assert_allclose(noted.impulse[i, -1, :2], lost, atol=0.1)


def test_what_the_box_loses_the_character_gains(scene, bumps):
    noted, body, _ = bumps
    for i, side in enumerate(SIDES):
        character, opponent = momentum(scene, body, (i, -1))
        np.testing.assert_allclose(character, noted.impulse[i, -1], atol=0.3)
        before = -MASS * np.array([np.cos(side), np.sin(side)])
        np.testing.assert_allclose((character + opponent)[:2], before, atol=0.3)


def test_a_bump_is_fed_to_the_bodies_it_hits_while_it_lasts(scene, bumps):
    noted, _, forces = bumps
    assert forces.force_w.shape == (len(SIDES), STEPS, 4, 3)
    size = np.linalg.norm(forces.force_w, axis=-1)
    from_left, from_right = 2, 6
    left_arm, right_arm = 2, 3
    assert size[from_left, :, left_arm].max() > 50.0
    assert not size[from_left, :, right_arm].any()
    assert size[from_right, :, right_arm].max() > 50.0
    assert not size[from_right, :, left_arm].any()
    total = np.linalg.norm(forces.force_w.sum(axis=2), axis=-1)
    np.testing.assert_allclose(noted.force_peak[:, -1], total.max(axis=1), rtol=1e-3)
    # Before the box arrives there is exactly nothing, and the clock does not run.
    touching = size.any(axis=2)
    first = touching.argmax(axis=1)
    assert first.min() > 5
    for i, start in enumerate(first):
        assert (noted.since_bump[i, :start] >= LONG).all()
        assert noted.coming[i, :start].all() and not noted.coming[i, start:].any()
        since = (STEPS - 1 - start) * scene.timestep
        np.testing.assert_allclose(noted.since_bump[i, -1], since, atol=1e-4)


def test_forces_act_where_the_bodies_meet(bumps):
    _, body, forces = bumps
    size = np.linalg.norm(forces.force_w, axis=-1)
    i, t, b = np.unravel_index(size.argmax(), size.shape)
    towards = forces.force_w[i, t, b] / size[i, t, b]
    away = np.array([np.cos(SIDES[i]), np.sin(SIDES[i]), 0.0])
    assert towards @ away < -0.5  # pushed along the box's way
    assert 0.6 < forces.point_w[i, t, b, 2] < 1.6
    root = body.qpos[i, t, :2]
    assert 0.0 < (forces.point_w[i, t, b, :2] - root) @ away[:2] < 0.4


def test_attacks_come_from_all_sides_at_the_character(scene, began, attacks):
    _, start = began
    _, body = attacks
    adr, dof = box(scene)
    root = np.array(start.qpos[scene.qpos_adr :][:2])
    offset = body.qpos[:, adr : adr + 2] - root
    velocity = body.qvel[:, dof : dof + 2]
    speed = np.linalg.norm(velocity, axis=-1)
    slow, fast = TASK.speed
    assert slow <= speed.min() < slow + 0.05 and fast - 0.05 < speed.max() <= fast
    cross = offset[:, 0] * velocity[:, 1] - offset[:, 1] * velocity[:, 0]
    aside = np.abs(cross) / speed
    assert 0.5 * TASK.off_centre < aside.max() <= TASK.off_centre + 1e-5
    np.testing.assert_allclose(
        -np.sum(offset * velocity, axis=-1) / speed, TASK.distance, atol=1e-5
    )
    # One face ahead, and as often from one quadrant as from another.
    facing = body.qpos[:, adr + 2]
    np.testing.assert_allclose(np.cos(facing), -velocity[:, 0] / speed, atol=1e-5)
    quadrants = np.histogram(facing, bins=4, range=(-np.pi, np.pi))[0]
    assert quadrants.min() > 30


def test_an_attack_takes_its_time_and_then_waits_for_the_next(scene, began, attacks):
    state, _ = attacks
    np.testing.assert_allclose(state.next_attack, TASK.interval - CONTROL_DT, atol=1e-6)
    waiting, body = began
    after, same = TASK.control_step(jax.random.key(3), scene, waiting, body)
    np.testing.assert_allclose(
        after.next_attack, waiting.next_attack - CONTROL_DT, atol=1e-6
    )
    np.testing.assert_array_equal(same.qpos, body.qpos)
    assert state.coming.all() and after.coming


def test_the_box_lets_go_after_a_bump_and_not_before(scene, began):
    state, body = began
    _, dof = box(scene)
    body = dataclasses.replace(body, qvel=body.qvel.at[dof].set(1.0))
    state = dataclasses.replace(state, next_attack=jnp.ones(()))
    braked = np.exp(-CONTROL_DT / TASK.brake_time)
    for coming, since, expected in (
        (True, LONG, 1.0),
        (False, 0.1, 1.0),
        (False, 0.5, braked),
        (True, 2.0, 1.0),
    ):
        noted = dataclasses.replace(
            state, coming=jnp.array(coming), since_bump=jnp.array(since)
        )
        _, after = TASK.control_step(jax.random.key(4), scene, noted, body)
        np.testing.assert_allclose(after.qvel[dof], expected, rtol=1e-5)


def test_the_opponent_is_seen_from_the_character(scene, began):
    state, body = began
    adr, dof = box(scene)
    turn = np.array([np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)])
    qpos = np.array(body.qpos)
    qpos[scene.qpos_adr : scene.qpos_adr + 7] = (1.0, 2.0, 0.9, *turn)
    qpos[adr : adr + 2] = (1.0, 2.7)
    qvel = np.zeros(scene.model.nv)
    qvel[scene.dof_adr : scene.dof_adr + 2] = (0.0, 0.1)
    qvel[dof : dof + 2] = (0.3, -0.4)
    state = TASK.observe(
        scene, state, physics.initial_state(scene, jnp.asarray(qpos), jnp.asarray(qvel))
    )
    # Facing +y: 0.7 m ahead, closing at 0.5 m/s, moving to the right.
    np.testing.assert_allclose(state, [0.7, 0.0, -0.5, -0.3], atol=1e-5)


def test_hops_travel_as_fast_as_their_path_to_every_side(scene):
    """A sole that stands keeps its place on the ground, whichever way they go."""
    references = hops()
    model = compose_scene(load_character(), floor=False)
    data = mujoco.MjData(model)
    times = np.arange(0.0, float(references.duration[0]), 1.0 / 120.0)
    pose = jax.jit(
        jax.vmap(partial(chicken_fight.hopping, references), in_axes=(0, None))
    )
    heel = [f"left_sole_{side}" for side in ("heel_in", "heel_out")]
    soles = [model.geom(name).id for name in heel]

    def slide(velocity: np.ndarray) -> float:
        """How fast the heel moves while it is lowest, m/s."""
        qpos = np.array(pose(jnp.asarray(times), jnp.asarray(velocity)))
        qpos[:, :2] += times[:, None] * velocity
        spots = []
        for q in qpos:
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            spots.append(data.geom_xpos[soles].mean(axis=0))
        spots = np.array(spots)
        speed = np.linalg.norm(np.gradient(spots[:, :2], times[1], axis=0), axis=1)
        return float(np.median(speed[spots[:, 2] < np.quantile(spots[:, 2], 0.2)]))

    on_the_spot = slide(np.zeros(2))
    for side in SIDES:
        there = 0.4 * np.array([np.cos(side), np.sin(side)])
        assert slide(there) < on_the_spot + 0.03


def test_the_reference_goes_where_its_path_goes(scene):
    references = hops()
    first = jax.jit(
        lambda key, begin: TASK.first_reference(key, references, begin),
        static_argnums=1,
    )
    for key in jax.random.split(jax.random.key(5), 8):
        first_key, key = jax.random.split(key)
        at = first(first_key, False)
        covered = (at.qpos - at.qpos_previous)[:2] / CONTROL_DT
        np.testing.assert_allclose(covered, at.travel, atol=1e-4)
        np.testing.assert_allclose(at.qvel[:2], at.travel, atol=1e-4)
        speed = float(jnp.linalg.norm(at.travel))
        assert np.abs(np.subtract(TASK.gaits.speeds, speed)).min() < 1e-5
        reset_key, step_key = jax.random.split(key)
        state, qpos, qvel = TASK.reset(reset_key, scene, at)
        body = physics.initial_state(scene, qpos, qvel)
        state, _ = TASK.control_step(step_key, scene, state, body)
        after = TASK.reference(references, state, at, CONTROL_DT)
        np.testing.assert_allclose(
            (after.qpos - at.qpos)[:2] / CONTROL_DT, at.travel, atol=0.06
        )
    standing = first(jax.random.key(5), True)
    assert not standing.travel.any() and standing.time == 0.0


def test_who_begins_at_rest_will_hop_away_from_the_box(scene):
    references = hops()
    first_key, key = jax.random.split(jax.random.key(6))
    at = TASK.first_reference(first_key, references, True)
    state, qpos, _ = TASK.reset(key, scene, at)
    adr, _ = scene.address("box")
    away = np.asarray(at.qpos[:2] - qpos[adr : adr + 2])
    heading = float(state.motion.heading)
    np.testing.assert_allclose(
        away,
        2.0 * TASK.distance * np.array([np.cos(heading), np.sin(heading)]),
        atol=1e-5,
    )


def test_slow_hops_go_where_they_are_going(scene):
    slow = chicken_fight.hopping_at(hops(), jnp.zeros(()), jnp.array([0.0, 0.05]))
    state, _, _ = TASK.reset(jax.random.key(0), scene, slow)
    np.testing.assert_allclose(state.motion.heading, np.pi / 2, atol=1e-5)
    np.testing.assert_allclose(state.motion.speed, 0.05, rtol=1e-3)


@pytest.mark.parametrize("speed", [-0.1, 3.0, float("nan")])
def test_speeds_that_no_hops_have_are_refused(speed):
    with pytest.raises(ValueError, match=r"task\.gaits\.speeds must be in"):
        ChickenFight(gaits=paths.Gaits(speeds=(0.0, speed)))


def test_clips_that_are_no_three_hops_are_refused():
    with pytest.raises(ValueError, match="three loops"):
        chicken_fight.hopping(hops(("walk_cycle",)), jnp.zeros(()), jnp.zeros(2))


def test_a_character_moves_alike_at_any_mass():
    """So that a policy trained at 65 kg plays at 36 and at 85 kg as well."""

    def played(mass: float):
        made = config.make_config("chicken-fight")
        env = dataclasses.replace(made.env, mass=mass, alpha=0.16)
        fast = dataclasses.replace(made.task, speed=(0.9, 1.0))
        environment = tasks.make_environment(fast, env)

        def step(state, at):
            key, action = at
            state = environment.step(key, state, action)
            force = state.task.force_peak / environment.scene.character.mass
            return state, (state.body.qpos, state.displacement.u, state.obs, force)

        @jax.jit
        def play(key):
            reset_key, action_key, step_key = jax.random.split(key, 3)
            state = environment.reset(reset_key)
            soon = dataclasses.replace(state.task, next_attack=jnp.zeros(()))
            state = dataclasses.replace(state, task=soon)
            actions = 0.05 * jax.random.normal(action_key, (30, 36))
            keys = jax.random.split(step_key, 30)
            return jax.lax.scan(step, state, (keys, actions))[1]

        return [play(jax.random.key(seed)) for seed in range(4)]

    light, heavy = played(MASS), played(85.0)
    assert np.max([force for *_, force in light]) > 1.0, "N/kg: the box touched it"
    chex.assert_trees_all_close(light, heavy, atol=5e-3, rtol=5e-3)
