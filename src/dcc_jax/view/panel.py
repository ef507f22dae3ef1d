"""The controls of a page. What they are set to is asked for by the loop.

Callbacks come from viser's threads; they only put work into the viewer's queue.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import viser

from dcc_jax.character import BODIES
from dcc_jax.play import actions
from dcc_jax.play.program import Program
from dcc_jax.play.simulation import Simulation
from dcc_jax.view.plots import Plots
from dcc_jax.view.stage import Looks

SPRINGS = (50, 2000, 50, 400)  # N/m: least, greatest, step, at first
STRENGTHS = (0, 300, 5, 60)  # N of a push
FREE_ALPHA = 0.9  # greatest alpha offered where the policy knows one alone


class Owner(Protocol):
    """What carries out what the controls ask for."""

    name: str
    known: tuple[str, ...]
    seed: int
    looks: Looks

    def ask(self, work: Callable[[Simulation], None]) -> None: ...
    def load(self, name: str, task: Mapping[str, Any] | None = None) -> None: ...
    def save(self, kind: str) -> None: ...
    def restart(self, seed: int | None = None) -> None: ...
    def one_step(self) -> None: ...
    def restring(self) -> None: ...
    def set_plain(self, plain: bool) -> None: ...


class Panel:
    """Everything beside the scene."""

    def __init__(self, viewer: Owner, server: viser.ViserServer) -> None:
        self._viewer, self._gui = viewer, server.gui
        self._own: list[Any] = []  # what belongs to the policy of the moment
        server.gui.configure_theme(control_layout="fixed", show_logo=False)
        server.gui.set_panel_label("dcc_jax")
        # Text that is set four times a second: markdown would be compiled every time.
        self.status = server.gui.add_html("starting ...")
        self._add_policy()
        self._add_compliance()
        self._add_pull()
        self._task_folder = server.gui.add_folder("Skill")
        self._add_time()
        self._add_looks()
        with server.gui.add_folder("Last ten seconds"):
            self.plots = Plots(server.gui)
        self._add_saving()

    def _asks(self, work: Callable[[Simulation], None]) -> Callable[[Any], None]:
        """A callback that has the loop do something with the simulation."""
        return lambda event: self._viewer.ask(work)

    def _add_policy(self) -> None:
        known = self._viewer.known
        self.policy = self._gui.add_dropdown(
            "Policy", known, initial_value=self._viewer.name
        )
        self.policy.on_update(self._chosen)

    def _chosen(self, event: Any) -> None:
        # Without a client it was the program itself that set the value.
        if event.client is not None:
            self._viewer.load(self.policy.value)

    def _add_compliance(self) -> None:
        with self._gui.add_folder("Compliance"):
            self.alpha = self._gui.add_slider(
                "alpha", 0.0, 1.0, 0.01, 0.0, hint="share by which a point yields"
            )
            self.u_off = self._gui.add_checkbox(
                "u off",
                False,
                hint="the policy is told alpha, and nothing is displaced",
            )
        self.alpha.on_update(self._asks(lambda s: _set(s, alpha=self.alpha.value)))
        self.u_off.on_update(self._asks(lambda s: _set(s, u_on=not self.u_off.value)))

    def _add_pull(self) -> None:
        with self._gui.add_folder("Pull and push"):
            self._gui.add_markdown("Drag any body with the left mouse button.")
            low, high, step, start = SPRINGS
            self.spring = self._gui.add_slider("spring, N/m", low, high, step, start)
            bodies: tuple[str, ...] = BODIES
            self.pushed = self._gui.add_dropdown("body", bodies, initial_value="chest")
            low, high, step, start = STRENGTHS
            self.strength = self._gui.add_slider("push, N", low, high, step, start)
            self.bearing = self._gui.add_slider(
                "towards, deg", -180, 180, 15, 0, hint="0 ahead (x), 90 left (y)"
            )
            self.seconds = self._gui.add_slider("for, s", 0.1, 5.0, 0.1, 1.0)
            push = self._gui.add_button("push")
        self.spring.on_update(self._asks(lambda s: self._viewer.restring()))
        push.on_click(self._asks(self._push))

    def _push(self, simulation: Simulation) -> None:
        angle = np.radians(self.bearing.value)
        force = self.strength.value * np.array([np.cos(angle), np.sin(angle), 0.0])
        simulation.push(self.pushed.value, force, self.seconds.value)

    def _add_time(self) -> None:
        with self._gui.add_folder("Time"):
            reset = self._gui.add_button("reset")
            self.paused = self._gui.add_checkbox("pause", False)
            one = self._gui.add_button("one step")
            self.speed = self._gui.add_slider("speed", 0.1, 1.0, 0.05, 1.0)
            self.seed = self._gui.add_number(
                "seed", self._viewer.seed, min=0, max=2**32 - 1, step=1
            )
        reset.on_click(self._asks(lambda s: self._viewer.restart()))
        one.on_click(self._asks(lambda s: self._viewer.one_step()))
        self.seed.on_update(
            self._asks(lambda s: self._viewer.restart(seed=int(self.seed.value)))
        )

    def _add_looks(self) -> None:
        looks = self._viewer.looks
        with self._gui.add_folder("Look", expand_by_default=False):
            for name, label in (
                ("follow", "camera follows"),
                ("ghost", "ghost: the pose with or without u"),
                ("arrows", "forces"),
                ("shells", "where 50 N take the held point: K green, K_hat blue"),
            ):
                box = self._gui.add_checkbox(label, getattr(looks, name))
                box.on_update(
                    lambda event, name=name, box=box: setattr(looks, name, box.value)
                )
            plain = self._gui.add_checkbox("plain: fast without a graphics card", False)
            plain.on_update(lambda event: self._viewer.set_plain(plain.value))

    def _add_saving(self) -> None:
        with self._gui.add_folder("Save the last ten seconds"):
            for kind in ("mp4", "gif", "npz"):
                button = self._gui.add_button(
                    f"clip .{kind}" if kind == "npz" else f"film .{kind}"
                )
                button.on_click(lambda event, kind=kind: self._viewer.save(kind))

    def of_policy(self, simulation: Simulation) -> None:
        """Sets what depends on the policy and its task."""
        low, high = simulation.run.alphas
        self.alpha.min, self.alpha.max = low, high if high > low else FREE_ALPHA
        self.alpha.value = simulation.alpha
        self.u_off.value = not simulation.u_on
        for handle in self._own:
            handle.remove()
        self._own = []
        with self._task_folder:
            self._add_actions(simulation)
            self._add_parameters(simulation.program)

    def _add_actions(self, simulation: Simulation) -> None:
        for action in actions.of(simulation.task):
            name = action.name
            if action.low is not None and action.high is not None:
                slider = self._gui.add_slider(
                    f"{name}, {action.unit}", action.low, action.high, 0.05, 0.0
                )
                slider.on_update(
                    self._asks(
                        lambda s, name=name, own=slider: s.act(name, float(own.value))
                    )
                )
                self._own.append(slider)
            else:
                button = self._gui.add_button(name)
                button.on_click(self._asks(lambda s, name=name: s.act(name)))
                self._own.append(button)
        if simulation.task.event is not None:
            box = self._gui.add_checkbox("also by itself", simulation.events_on)
            box.on_update(self._asks(lambda s: _set(s, events_on=box.value)))
            self._own.append(box)

    def _add_parameters(self, program: Program) -> None:
        for name, (low, high) in program.task.adjustable.items():
            slider = self._gui.add_slider(
                f"{name}, m", low, high, 0.05, float(getattr(program.task, name))
            )
            button = self._gui.add_button(f"make it that {name}")
            button.on_click(
                lambda event, name=name, own=slider: self._viewer.load(
                    self._viewer.name, {name: float(own.value)}
                )
            )
            self._own += [slider, button]


def _set(simulation: Simulation, **values: Any) -> None:
    for name, value in values.items():
        setattr(simulation, name, value)
