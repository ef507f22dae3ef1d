"""Exchanges between devices happen in one order that the data enforces."""

import jax
import jax.numpy as jnp
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jax.sharding import NamedSharding, PartitionSpec

from dcc_jax import config, tasks
from dcc_jax.learn import discriminator, learner, networks, ppo
from dcc_jax.learn.exchange import all_gather_tree
from toy import Toy

EXCHANGES = {"psum", "psum_invariant", "all_gather", "pmax", "pmin", "ppermute"}
LOOPS = {"scan", "while"}


def _inner(equation: JaxprEqn) -> list[Jaxpr]:
    parts = jax.tree.leaves(
        list(equation.params.values()), is_leaf=lambda x: isinstance(x, Jaxpr)
    )
    parts = [p.jaxpr if isinstance(p, ClosedJaxpr) else p for p in parts]
    return [p for p in parts if isinstance(p, Jaxpr)]


def _exchanges(equation: JaxprEqn) -> bool:
    return equation.primitive.name in EXCHANGES or any(
        _exchanges(inner) for jaxpr in _inner(equation) for inner in jaxpr.eqns
    )


def _unordered(jaxpr: Jaxpr) -> list[str]:
    """Pairs of exchanges, one of them in a loop, that may run side by side."""
    found: list[str] = []
    after: dict = {}  # variable: numbers of the exchanges its value depends on
    before: list[JaxprEqn] = []
    for equation in jaxpr.eqns:
        known = [
            after.get(v, set()) for v in equation.invars if not isinstance(v, Literal)
        ]
        depends = set().union(*known)
        if _exchanges(equation):
            for i, earlier in enumerate(before):
                names = {earlier.primitive.name, equation.primitive.name}
                if i not in depends and not names <= EXCHANGES:
                    found.append(f"{earlier.primitive.name}, {equation.primitive.name}")
            depends = depends | {len(before)}
            before.append(equation)
        for variable in equation.outvars:
            after[variable] = depends
        for inner in _inner(equation):
            found += _unordered(inner)
    return found


@pytest.mark.parametrize(("task", "tracks"), [("push", False), ("door", True)])
def test_programs_leave_no_exchange_beside_a_loop_with_exchanges(task, tracks):
    """Of tasks that imitate and that follow in time; no environment exchanges."""
    run = config.make_config(task, "smoke")
    assert tasks.make_task(task).follows_reference == tracks
    environment = Toy(tracks_reference=tracks)
    mesh = learner.make_mesh(run.train)
    init = learner.make_init(environment, run, mesh)
    key = jax.random.key(0)
    state = jax.eval_shape(init, key, None)
    update = learner.make_update(environment, run, mesh)
    for program in (jax.make_jaxpr(init)(key, None), jax.make_jaxpr(update)(state)):
        assert any(_exchanges(equation) for equation in program.jaxpr.eqns)
        assert not _unordered(program.jaxpr)


def _over_devices(f, x):
    """The function f of x, which the devices share."""
    mesh = learner.make_mesh(config.make_config("push", "smoke").train)
    spec = PartitionSpec("env")
    f = jax.shard_map(f, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return f, jax.device_put(x, NamedSharding(mesh, spec))


def test_exchange_beside_a_loop_with_exchanges_is_found():
    def both(x):
        mean = jax.lax.pmean(x, "env")
        looped, _ = jax.lax.scan(
            lambda y, _: (jax.lax.pmean(y, "env"), None), x, length=3
        )
        return mean + looped

    program, x = _over_devices(both, jnp.ones(2 * len(jax.devices())))
    (shared,) = jax.make_jaxpr(program)(x).jaxpr.eqns
    found = _unordered(*_inner(shared))
    assert found == ["psum, scan"]


def test_gathered_keeps_structure_and_types_and_the_order_of_devices():
    devices = len(jax.devices())

    def here(x):
        mine = {"index": jax.lax.axis_index("env"), "x": x}
        return jax.tree.map(lambda leaf: leaf[None], all_gather_tree(mine, "env"))

    program, x = _over_devices(here, jnp.arange(3.0 * devices))
    of_all = jax.jit(program)(x)
    assert of_all["index"].dtype == jnp.int32
    for index, x_all in zip(of_all["index"], of_all["x"], strict=True):
        assert list(index) == list(range(devices))
        assert jnp.array_equal(x_all.reshape(-1), x)


def _crossing(jaxpr: Jaxpr) -> int:
    """Arrays that a program sends across devices, those of its loops counted once."""
    return sum(
        len(equation.invars)
        if equation.primitive.name in EXCHANGES
        else sum(_crossing(inner) for inner in _inner(equation))
        for equation in jaxpr.eqns
    )


def _sent(f, *arguments) -> int:
    mesh = learner.make_mesh(config.make_config("push", "smoke").train)
    everywhere = PartitionSpec()
    f = jax.shard_map(
        f, mesh=mesh, in_specs=everywhere, out_specs=everywhere, check_vma=False
    )
    return _crossing(jax.make_jaxpr(f)(*arguments).jaxpr)


def test_gradients_of_a_ppo_step_and_its_divergence_cross_as_one_array():
    settings = config.make_config("push", "smoke").ppo
    rows = settings.minibatch_size
    agent = ppo.init_agent(jax.random.key(0), 3, 2, settings)
    many = jnp.zeros(rows)
    batch = ppo.Batch(jnp.zeros((rows, 3)), jnp.zeros((rows, 2)), many, many, many)

    def update(key):
        return ppo.update(key, agent, batch, settings, "env")

    assert _sent(update, jax.random.key(1)) == 1


def test_gradient_of_a_discriminator_step_crosses_as_one_array():
    settings = discriminator.DiscriminatorConfig()
    params = networks.init_mlp(jax.random.key(0), (4, 5, 1))
    network = networks.init_network(params, discriminator.make_optimizer(settings))

    def update(x):
        return discriminator.update(network, x, x, settings, "env")

    assert _sent(update, jnp.zeros((2, 3, 4))) == 1
