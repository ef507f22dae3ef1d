"""The ball on the head: an inverted pendulum, its pushes, and forces that are not."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dcc_jax import physics, quat
from dcc_jax.character import Character, asset_path, compose_scene
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.environment import Environment
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.reference import make_references
from dcc_jax.tasks import ball
from dcc_jax.tasks.ball import Ball

TASK = Ball()
GRAVITY = 9.81  # m/s^2
# Of pole and ball about the pivot, from the fields alone: a rod and a full sphere.
MOMENT = TASK.pole_length * (0.5 * TASK.pole_mass + TASK.ball_mass)  # kg m
INERTIA = (
    TASK.pole_mass * TASK.pole_length**2 / 3
    + TASK.ball_mass * TASK.pole_length**2
    + 0.4 * TASK.ball_mass * TASK.ball_radius**2
)  # kg m^2


@pytest.fixture(scope="module")
def environment(character: Character) -> Environment:
    references = make_references([load_clip(asset_path("motions/stand.npz"))])
    return Environment(TASK, character, references, EnvConfig())


# The scene.


def test_pole_and_ball_have_the_mass_and_the_inertia_that_the_fields_say(environment):
    model = environment.scene.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pole = model.body("pole")
    np.testing.assert_allclose(pole.mass, TASK.pole_mass + TASK.ball_mass)
    np.testing.assert_allclose(pole.mass * pole.ipos[2], MOMENT, rtol=1e-6)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    dof = model.joint("pole").dofadr[0]
    # The caps of the capsule are not those of a thin rod.
    tilting = np.diag(full)[dof + 3 : dof + 5]
    np.testing.assert_allclose(tilting, INERTIA, rtol=2e-3)


def test_the_ball_is_at_the_tip_and_the_pole_is_joined_to_the_crown(environment):
    model = environment.scene.model
    assert model.geom("ball").pos.tolist() == [0.0, 0.0, TASK.pole_length]
    assert model.geom("ball").size[0] == TASK.ball_radius
    assert model.joint("pole").type == mujoco.mjtJoint.mjJNT_FREE
    assert model.eq_type.tolist() == [mujoco.mjtEq.mjEQ_CONNECT]
    assert model.eq_active0.tolist() == [1]
    joined = [model.site(model.eq_obj1id[0]), model.site(model.eq_obj2id[0])]
    owners = [model.body(int(site.bodyid[0])).name for site in joined]
    assert owners == ["head", "pole"]
    head = model.geom("head")
    top = head.pos + np.array([0.0, 0.0, head.size[0]])
    np.testing.assert_allclose(joined[0].pos, top, atol=1e-9)
    assert joined[1].pos.tolist() == [0.0, 0.0, 0.0]


def test_an_episode_begins_with_the_pole_on_the_crown_near_upright(environment):
    scene, model = environment.scene, environment.scene.model
    data, tilts = mujoco.MjData(model), []
    for seed, seconds in enumerate((0.5, 3.0, 7.0)):
        reference = environment.references.state_at(0, seconds)
        _, qpos, qvel = TASK.reset(jax.random.key(seed), scene, reference)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        gap = data.site("crown").xpos - data.site("foot_of_pole").xpos
        assert np.linalg.norm(gap) < 1e-5
        tilts.append(np.arccos(data.body("pole").xmat[8]))
    assert 0.0 < max(tilts) < np.sqrt(2.0) * TASK.tilt + 1e-3


def undriven(scene: physics.Scene, qpos, steps: int, read) -> np.ndarray:
    """What `read` says of the body after each physics step from rest, [steps, ...]."""

    def step(body: physics.State, _):
        kin = physics.kinematics(scene, body)
        solution = physics.solve(scene, kin, body, jnp.zeros(scene.model.nv))
        body = physics.integrate(scene, body, solution)
        return body, read(body)

    def go(qpos):
        body = physics.initial_state(scene, qpos, jnp.zeros(scene.model.nv))
        return jax.lax.scan(step, body, None, length=steps)[1]

    return np.asarray(jax.jit(go)(qpos), float)


# The pendulum.


@pytest.fixture(scope="module")
def pinned(character: Character) -> physics.Scene:
    """The scene with a character too heavy to move, upright as MuJoCo has it."""
    model = compose_scene(character, floor=False, extend=TASK.extend)
    model.dof_armature[: character.nv] = 1e5
    return physics.make_scene(model, character)


@pytest.fixture(scope="module")
def tipping(pinned) -> np.ndarray:
    """Angle of the pole from the vertical every physics step, from 0.1 rad, [T]."""
    start = jnp.asarray(pinned.model.qpos0, jnp.float32)
    q_adr, _ = pinned.address("pole")
    head = pinned.model.body("head").id
    data = mujoco.MjData(pinned.model)
    mujoco.mj_kinematics(pinned.model, data)
    crown = data.xpos[head] + np.asarray(ball.CROWN)
    lean = np.array([np.cos(0.05), np.sin(0.05), 0.0, 0.0])
    pose = jnp.asarray(np.concatenate([crown, lean]), jnp.float32)
    start = start.at[q_adr : q_adr + 7].set(pose)

    return np.arccos(undriven(pinned, start, 180, partial(ball._upright, pinned)))


def test_the_pole_tips_at_the_analytic_rate(pinned, tipping):
    """I theta'' = m g l sin theta, which grows by exp(sqrt(m g l / I) t)."""
    rate = np.sqrt(MOMENT * GRAVITY / INERTIA)
    times = pinned.timestep * np.arange(1, len(tipping) + 1)
    expected = solve_ivp(
        lambda t, x: [x[1], rate**2 * np.sin(x[0])],
        (0.0, times[-1]),
        [0.1, 0.0],
        t_eval=times,
        rtol=1e-8,
    ).y[0]
    assert expected[-1] > 0.3, "long enough to tell one rate from another"
    np.testing.assert_allclose(tipping, expected, rtol=0.03)


def test_a_push_changes_the_balls_velocity_and_not_the_pivots(environment):
    scene = environment.scene
    reference = environment.references.state_at(0, 1.0)
    _, qpos, qvel = TASK.reset(jax.random.key(0), scene, reference)
    q_adr, _ = scene.address("pole")
    leaning = quat.exp(jnp.array([0.3, -0.2, 0.1]))
    qpos = qpos.at[q_adr + 3 : q_adr + 7].set(leaning)
    body = physics.initial_state(scene, qpos, qvel)
    upright = physics.initial_state(
        scene, qpos.at[q_adr + 3 : q_adr + 7].set(jnp.array([1.0, 0, 0, 0])), qvel
    )
    speeds = []
    for seed in range(8):
        key, again = jax.random.split(jax.random.key(seed))
        for start, keep in ((body, False), (upright, True)):
            state, pushed = TASK.control_step(
                jax.random.clone(key), scene, ball.BallState(jnp.asarray(-0.01)), start
            )
            before, after = (
                [ball._along_pole(scene, b, h)[1] for h in (0.0, TASK.pole_length)]
                for b in (start, pushed)
            )
            np.testing.assert_allclose(after[0], before[0], atol=1e-6)
            change = np.asarray(after[1] - before[1])
            assert np.linalg.norm(change) <= TASK.push[1] + 1e-5
            if keep:
                assert abs(change[2]) < 1e-6, "the push is horizontal"
                speeds.append(np.linalg.norm(change))
            assert float(state.next_push) > TASK.interval - 0.1
        waiting = ball.BallState(jnp.asarray(0.5))
        _, rest = TASK.control_step(again, scene, waiting, body)
        np.testing.assert_array_equal(rest.qvel, body.qvel)
    low, high = TASK.push
    assert low <= min(speeds) and max(speeds) <= high + 1e-6
    assert max(speeds) - min(speeds) > 0.2 * (high - low)


# What the policy sees and gets.


@pytest.mark.parametrize("lean", [0.0, 0.4])
def test_reward_falls_with_the_balls_offset_from_the_head(environment, lean):
    scene = environment.scene
    reference = environment.references.state_at(0, 1.0)
    _, qpos, qvel = TASK.reset(jax.random.key(0), scene, reference)
    q_adr, _ = scene.address("pole")
    turn = quat.exp(jnp.array([0.0, lean, 0.0]))
    body = physics.initial_state(scene, qpos.at[q_adr + 3 : q_adr + 7].set(turn), qvel)
    data = mujoco.MjData(scene.model)
    data.qpos[:] = body.qpos
    mujoco.mj_kinematics(scene.model, data)
    apart = (data.geom("ball").xpos - data.geom("head").xpos)[:2]
    expected = np.exp(-2.0 * apart @ apart)
    np.testing.assert_allclose(TASK.reward(scene, None, body), expected, rtol=1e-5)
    numbers = TASK.evaluate(scene, None, body)
    np.testing.assert_allclose(numbers["offset"], np.linalg.norm(apart), rtol=1e-4)
    np.testing.assert_allclose(numbers["lean"], lean, atol=1e-3)


def test_the_ball_is_lost_when_the_pole_leans_too_far(environment):
    scene = environment.scene
    qpos = jnp.asarray(scene.model.qpos0, jnp.float32)
    q_adr, _ = scene.address("pole")
    for lean, lost in ((TASK.dropped - 0.05, False), (TASK.dropped + 0.05, True)):
        turn = quat.exp(jnp.array([0.6, 0.8, 0.0]) * lean)
        body = physics.initial_state(
            scene, qpos.at[q_adr + 3 : q_adr + 7].set(turn), jnp.zeros(scene.model.nv)
        )
        assert bool(TASK.terminated(scene, None, body)) is lost


def test_what_is_observed_does_not_depend_on_place_and_heading(environment):
    scene, model = environment.scene, environment.scene.model
    reference = environment.references.state_at(0, 1.0)
    _, qpos, qvel = TASK.reset(jax.random.key(0), scene, reference)
    q_adr, v_adr = scene.address("pole")
    qvel = qvel.at[v_adr : v_adr + 6].set(jnp.array([0.3, -0.2, 0.1, 0.5, 0.7, 0.0]))
    here = TASK.observe(scene, None, physics.initial_state(scene, qpos, qvel))
    turn = quat.exp(jnp.array([0.0, 0.0, 1.1]))
    moved_q, moved_v = qpos, qvel
    for q, v in ((0, 0), (q_adr, v_adr)):
        place = quat.rotate(turn, qpos[q : q + 3]) + jnp.array([2.0, -1.0, 0.0])
        moved_q = moved_q.at[q : q + 3].set(place)
        facing = quat.mul(turn, qpos[q + 3 : q + 7])
        moved_q = moved_q.at[q + 3 : q + 7].set(facing)
        moved_v = moved_v.at[v : v + 3].set(quat.rotate(turn, qvel[v : v + 3]))
    there = TASK.observe(scene, None, physics.initial_state(scene, moved_q, moved_v))
    np.testing.assert_allclose(there, here, atol=1e-5)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    J = np.zeros((3, model.nv))
    mujoco.mj_jacGeom(model, data, J, None, model.geom("ball").id)
    heading = quat.heading(qpos[3:7])
    speed_w = jnp.asarray(J @ data.qvel, jnp.float32)
    speed = quat.rotate(quat.inv(heading), speed_w)
    np.testing.assert_allclose(here[3:6], speed, atol=1e-5)
    np.testing.assert_allclose(here[2], data.geom("ball").xpos[2], atol=1e-5)


# The fictional forces.


@pytest.fixture(scope="module")
def played(environment):
    """Four control steps: alpha 0 or 0.16, extra actions none, head, root."""
    extra = np.zeros((4, 6), np.float32)
    extra[1] = [0.5, 0.2, 0.0, 0.0, 0.5, 0.0]  # at alpha = 0
    extra[2, :3] = [0.5, 0.0, 0.0]
    extra[3, 3:] = [0.0, 0.5, 0.0]
    alpha = jnp.array([0.0, 0.0, 0.16, 0.16])

    def play(extra, alpha):
        state = environment.reset(jax.random.key(0), alpha)
        action = jnp.concatenate([jnp.zeros(36), extra])

        def step(state, key):
            return environment.step(key, state, action), None

        keys = jax.random.split(jax.random.key(1), 4)
        return jax.lax.scan(step, state, keys)[0]

    return jax.jit(jax.vmap(play))(jnp.asarray(extra), alpha)


def test_fictional_forces_do_not_act_in_the_simulation(played):
    """Without compliance they change nothing at all."""
    np.testing.assert_array_equal(played.body.qpos[0], played.body.qpos[1])
    np.testing.assert_array_equal(played.displacement.u[0], played.displacement.u[1])


def test_fictional_forces_displace_head_and_root(environment, played):
    u = np.asarray(played.displacement.u)
    tangent = np.asarray(quat.log_map(environment.kinematics.coords, u[2]))
    assert np.linalg.norm(tangent[6:12]) > 0.005, "rad, spine and neck bend"
    root = played.displacement.u[3, :3]
    # Half an action for four control steps, critically damped on its way to u*.
    law, alpha = environment.config.compliance, environment.config.alpha
    rest = alpha / (1.0 - alpha) * 0.5 * TASK.root_force / law.root_stiffness
    t = np.sqrt(law.root_return_stiffness) * 4 / 30
    there = rest * (1.0 - (1.0 + t) * np.exp(-t))
    np.testing.assert_allclose(root, [0.0, there, 0.0], atol=0.01 * rest)
    assert (np.asarray(played.body.qpos[2]) != np.asarray(played.body.qpos[0])).any()
    assert not np.asarray(played.terminated).any()


# The ball that rolls.


ROLLS = Ball(rolls=True, tilt=0.0)


@pytest.fixture(scope="module")
def rolling(character: Character) -> Environment:
    references = make_references([load_clip(asset_path("motions/stand.npz"))])
    return Environment(ROLLS, character, references, EnvConfig())


def test_a_ball_rolls_down_its_plate_at_five_sevenths_of_the_slope(
    character: Character,
):
    """A full sphere that does not slide, on a plate that nothing moves."""
    lean = 0.1
    model = compose_scene(character, floor=False, extend=ROLLS.extend)
    model.dof_armature[: character.nv] = 1e6
    pole, sphere = (int(model.joint(name).dofadr[0]) for name in ("pole", "ball"))
    model.dof_armature[pole : pole + 6] = 1e6
    scene = physics.make_scene(model, character)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    crown = data.body("head").xpos + np.asarray(ball.CROWN)
    turn = np.array([np.cos(lean / 2), 0.0, np.sin(lean / 2), 0.0])
    up = np.array([np.sin(lean), 0.0, np.cos(lean)])
    qpos = np.array(model.qpos0)
    for name, place in (("pole", crown), ("ball", crown + ROLLS.pole_length * up)):
        adr = int(model.joint(name).qposadr[0])
        qpos[adr : adr + 7] = np.append(place, turn)

    speed = undriven(
        scene, jnp.asarray(qpos, jnp.float32), 72, lambda b: b.qvel[sphere : sphere + 6]
    )
    down = np.array([np.cos(lean), 0.0, -np.sin(lean)])
    turning = np.linalg.norm(speed[:, 3:], axis=1) * ROLLS.ball_radius
    expected = 5.0 / 7.0 * GRAVITY * np.sin(lean)
    for along in (speed[:, :3] @ down, turning):
        # Once the ball has settled into the soft contact.
        slope = np.diff(along[24:]) / scene.timestep
        np.testing.assert_allclose(slope, expected, rtol=0.01)


def test_a_push_makes_the_ball_roll_and_leaves_the_pole(rolling):
    scene = rolling.scene
    reference = rolling.references.state_at(0, 1.0)
    _, qpos, qvel = ROLLS.reset(jax.random.key(0), scene, reference)
    adr, dof = scene.address("ball")
    qpos = qpos.at[adr + 3 : adr + 7].set(quat.exp(jnp.array([0.4, 1.0, -0.3])))
    body = physics.initial_state(scene, qpos, qvel)
    due = ball.BallState(jnp.asarray(-0.01))
    _, pushed = ROLLS.control_step(jax.random.key(1), scene, due, body)
    change = np.array(pushed.qvel - body.qvel)
    velocity, spin = change[dof : dof + 3], change[dof + 3 : dof + 6]
    low, high = ROLLS.push
    assert low <= np.linalg.norm(velocity) <= high + 1e-6
    spin_w = np.asarray(quat.rotate(qpos[adr + 3 : adr + 7], jnp.asarray(spin)))
    below = np.array([0.0, 0.0, -ROLLS.ball_radius])
    np.testing.assert_allclose(velocity + np.cross(spin_w, below), 0.0, atol=1e-6)
    change[dof : dof + 6] = 0.0
    assert not change.any()


def test_a_ball_is_observed_where_it_rolls_and_is_lost_off_its_plate(rolling):
    scene = rolling.scene
    reference = rolling.references.state_at(0, 1.0)
    _, qpos, qvel = ROLLS.reset(jax.random.key(0), scene, reference)
    adr, dof = scene.address("ball")
    at_first = physics.initial_state(scene, qpos, qvel)
    first = ROLLS.observe(scene, None, at_first)
    heading = quat.heading(qpos[3:7])
    for off, lost in ((0.9 * ROLLS.plate, False), (1.1 * ROLLS.plate, True)):
        move = jnp.array([off, 0.0, 0.0])
        there = physics.initial_state(
            scene,
            qpos.at[adr : adr + 3].add(move),
            qvel.at[dof : dof + 3].add(10.0 * move),
        )
        seen = ROLLS.observe(scene, None, there) - first
        to_local = quat.inv(heading)
        np.testing.assert_allclose(seen[:3], quat.rotate(to_local, move), atol=1e-5)
        np.testing.assert_allclose(
            seen[3:6], quat.rotate(to_local, 10.0 * move), atol=1e-5
        )
        assert not np.asarray(seen[6:]).any()
        assert bool(ROLLS.terminated(scene, None, there)) is lost
    assert float(ROLLS.reward(scene, None, there)) < float(
        ROLLS.reward(scene, None, at_first)
    )


def test_a_plate_that_leans_has_the_ball_on_it_and_loses_it_on_every_side(rolling):
    scene, model = rolling.scene, rolling.scene.model
    np.testing.assert_allclose(model.body("pole").mass, TASK.pole_mass + 0.2)
    np.testing.assert_allclose(model.body("ball").mass, TASK.ball_mass)
    tilted = dataclasses.replace(ROLLS, tilt=0.2)
    reference = rolling.references.state_at(0, 1.0)
    _, qpos, qvel = tilted.reset(jax.random.key(5), scene, reference)
    foot, turn = ball._pole(scene, physics.initial_state(scene, qpos, qvel))
    assert float(jnp.abs(turn[1:3]).max()) > 0.02, "it leans"
    turn = quat.mul(turn, quat.exp(jnp.array([0.0, 0.0, 0.7])))
    pole, _ = scene.address("pole")
    qpos = qpos.at[pole + 3 : pole + 7].set(turn)
    adr, _ = scene.address("ball")
    tip = jnp.array([0.0, 0.0, ROLLS.pole_length])
    place = quat.rotate(turn, tip) + foot
    np.testing.assert_allclose(qpos[adr : adr + 3], place, atol=1e-5)
    for side in ([1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]):
        for share, lost in ((0.95, False), (1.05, True)):
            on_plate = tip.at[:2].set(share * ROLLS.plate * jnp.array(side))
            there = qpos.at[adr : adr + 3].set(foot + quat.rotate(turn, on_plate))
            body = physics.initial_state(scene, there, qvel)
            assert bool(ROLLS.terminated(scene, None, body)) is lost


def test_a_ball_lies_still_on_its_plate_at_first(rolling):
    """Neither does it fall on the plate nor is it thrown off by it."""

    def play(key):
        state = rolling.reset(key)
        waiting = ball.BallState(jnp.asarray(10.0))
        state = dataclasses.replace(state, task=waiting)
        for _ in range(3):
            state = rolling.step(jax.random.key(0), state, jnp.zeros(42))
        return state.body

    body = jax.jit(play)(jax.random.key(3))
    foot, turn = ball._pole(rolling.scene, body)
    place = quat.rotate(quat.inv(turn), ROLLS._ball(rolling.scene, body)[0] - foot)
    np.testing.assert_allclose(place, [0.0, 0.0, ROLLS.pole_length], atol=0.01)
    np.testing.assert_allclose(place[2], ROLLS.pole_length, atol=1e-3)


def test_numbers_that_make_no_ball_are_refused():
    with pytest.raises(ValueError, match=r"task\.pole_length must be positive, got 0"):
        Ball(pole_length=0.0)
    with pytest.raises(ValueError, match=r"task\.head_force must be 0 or more, got -1"):
        Ball(head_force=-1.0)
    with pytest.raises(ValueError, match=r"task\.plate must be positive, got 0"):
        Ball(plate=0.0)
    for push in ((0.3, 0.05), (float("nan"), 1.0), (-1.0, 0.0)):
        with pytest.raises(ValueError, match=r"task\.push must be a range"):
            Ball(push=push)
    with pytest.raises(ValueError, match=r"task\.dropped must be in"):
        Ball(dropped=-1.0)
    with pytest.raises(ValueError, match=r"task\.pole_length must be above 0\.13"):
        Ball(rolls=True, pole_length=0.13)
