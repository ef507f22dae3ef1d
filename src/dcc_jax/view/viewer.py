"""The loop between a simulation and a page.

One thread steps the simulation; callbacks of the page ask it to do things. Programs are
compiled in a thread of their own while the page shows the scene.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import viser

from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.play.program import Program
from dcc_jax.play.runs import find_run
from dcc_jax.play.simulation import Simulation
from dcc_jax.view import saving, status
from dcc_jax.view.grip import Grab, moved
from dcc_jax.view.panel import Panel
from dcc_jax.view.stage import ECHO, Looks, Stage

Ask = Callable[[Simulation], None]

PERIOD = 1.0 / CONTROL_RATE
STATUS_EVERY = 0.25  # s
PLOTS_EVERY = 1.0  # s
LATE = 0.25  # s behind, from which on time that is lost is not made up for
PROGRAMS = 3  # that are kept: going back to a skill is then immediate
FIRST_ALPHA = 0.5  # at most: what is softer gives way farther, and falls more often
LARGEST_FORCE = 1000.0  # N, that a mouse can pull with


class Viewer:
    """One simulation on one server, for any number of browsers."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        known: tuple[str, ...],
        *,
        seed: int = 0,
        alpha: float | None = None,
        task: Mapping[str, Any] | None = None,
        out: Path = Path(),
    ) -> None:
        """Builds the page; `run` fills it.

        Args:
            server: of the page.
            name: of the first policy.
            known: names of all that can be chosen.
            seed: of everything that is drawn.
            alpha: level of compliance at first; None: the greatest of the training, at
                most `FIRST_ALPHA`.
            task: parameters of the first policy's task.
            out: folder for what is saved.
        """
        self.server, self.name, self.seed = server, name, seed
        self.known = known if name in known else (name, *known)
        self.out, self.looks = out, Looks()
        self.simulation: Simulation | None = None
        self.note = ""
        """What went wrong or was saved, on the page for a while."""
        self.real_time_factor = 1.0
        self._alpha, self._task = alpha, dict(task or {})
        self._queue: queue.Queue[Callable[[], None]] = queue.Queue()
        self._programs: dict[str, Program] = {}
        self._stage: Stage | None = None
        self._grab: Grab | None = None
        self._grabber: int | None = None
        self._single = False
        self._loading: tuple[str, float] | None = None
        self._stop = threading.Event()
        self._meter = status.Meter(1.0)
        self.panel = Panel(self, server)
        server.initial_camera.position = (1.7, -2.0, 1.3)
        server.initial_camera.look_at = (0.0, 0.0, 0.85)
        server.scene.set_up_direction("+z")

        @server.on_client_disconnect
        async def _(client: viser.ClientHandle) -> None:
            self._queue.put(lambda: self._left(client.client_id))

    def ask(self, work: Ask) -> None:
        """Has the loop do something, once there is a simulation."""

        def asked() -> None:
            if self.simulation is not None:
                work(self.simulation)

        self._queue.put(asked)

    def load(self, name: str, task: Mapping[str, Any] | None = None) -> None:
        """Goes over to a policy, compiling its program first where that is needed."""
        self._queue.put(lambda: self._begin_loading(name, task))

    def save(self, kind: str) -> None:
        """Saves the last ten seconds, as `mp4`, `gif` or `npz`."""

        def saved(simulation: Simulation) -> None:
            moments = list(simulation.history)
            self.note = f"drawing a {kind} ..." if kind != "npz" else ""
            arguments = simulation, moments, kind, self.alpha_now
            threading.Thread(
                target=self._save, args=arguments, daemon=True, name="saving"
            ).start()

        self.ask(saved)

    def restart(self, seed: int | None = None) -> None:
        """The next episode, or the first one of a seed. Only the loop calls it."""
        assert self.simulation is not None
        self._let_go()
        self.note = ""
        self.simulation.reset(seed=seed, episode=None if seed is None else 0)

    def one_step(self) -> None:
        """A single control step while it is paused."""
        self.panel.paused.value = True
        self._single = True

    def restring(self) -> None:
        """The spring in hand has the stiffness of the slider."""
        if self._grab is not None:
            self._pull(self._grab)

    def set_plain(self, plain: bool) -> None:
        """See `Looks.plain`."""
        self.looks.plain = plain
        self._queue.put(lambda: self._stage and self._stage.set_plain(plain))

    @property
    def alpha_now(self) -> float:
        """The level that acts."""
        return 0.0 if self.simulation is None else self.simulation.level

    def close(self) -> None:
        """Ends `run`."""
        self._stop.set()

    def run(self) -> None:
        """Simulates and shows, until `close`."""
        self._queue.put(lambda: self._begin_loading(self.name, self._task))
        due = time.perf_counter()
        shown = plotted = 0.0
        while not self._stop.is_set():
            self._answer()
            now = time.perf_counter()
            if self._meter.wanted != self._wanted:
                self._meter = status.Meter(self._wanted)
            if self._moves():
                self._guarded(self._step)
                period = PERIOD / max(self.panel.speed.value, 0.05)
                self._meter.count(PERIOD)
            else:
                period = PERIOD
            due = max(due + period, now - LATE)
            if now - shown > STATUS_EVERY:
                shown = now
                self.real_time_factor = self._meter.factor(now)
                self._guarded(self._show_status)
            if now - plotted > PLOTS_EVERY and self.simulation is not None:
                plotted = now
                self._guarded(self._show_plots)
            time.sleep(max(0.0, due - time.perf_counter()))

    @property
    def _wanted(self) -> float:
        """Simulated seconds a second that are asked for."""
        if self._loading is not None or self.panel.paused.value:
            return 0.0
        return float(self.panel.speed.value)

    def _moves(self) -> bool:
        if self.simulation is None or self._loading is not None:
            return False
        single, self._single = self._single, False
        return single or not self.panel.paused.value

    def _answer(self) -> None:
        while True:
            try:
                work = self._queue.get_nowait()
            except queue.Empty:
                return
            self._guarded(work)

    def _guarded(self, work: Callable[[], Any]) -> None:
        """The page lives on whatever happens; it says what did."""
        try:
            work()
        except Exception as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            self.note = status.bold(reason[:200])

    def _step(self) -> None:
        simulation, stage = self.simulation, self._stage
        assert simulation is not None and stage is not None
        if self._grab is not None:
            self._pull(self._grab)
        moment = simulation.step()
        if moment.ended:
            self._let_go()
            if moment.ended == "the physics broke":
                self.note = "the physics broke: a new episode"
        ghost = simulation.ghost(moment) if self.looks.ghost else None
        recent = list(simulation.history)[-ECHO:]
        stage.show(recent, ghost, self.looks, self._grab, simulation.level)

    def _pull(self, grab: Grab) -> None:
        simulation, stage = self.simulation, self._stage
        assert simulation is not None and stage is not None
        target = grab.target + stage.offset
        stiffness = float(self.panel.spring.value)
        place = stage.place_w(grab)
        away = target - place
        reach = LARGEST_FORCE / stiffness
        far = float(np.linalg.norm(away))
        if far > reach:
            target = place + reach / far * away
        simulation.pull(grab.body, grab.point, target, stiffness)

    def _dragged(self, body: str, event: Any) -> None:
        """From viser's thread: what the mouse does."""
        client, phase = event.client_id, event.phase
        start, end = np.array(event.start_position), np.array(event.end_position)
        self._queue.put(lambda: self._drag(client, phase, body, start, end))

    def _drag(
        self, client: int, phase: str, body: str, start: np.ndarray, end: np.ndarray
    ) -> None:
        if phase == "start" and self._stage is not None:
            self._grab = Grab(body, self._stage.local_point(body, start), end)
            self._grabber = client
        elif client != self._grabber or self._grab is None:
            return
        elif phase == "end":
            self._let_go()
        else:
            self._grab = moved(self._grab, end)

    def _left(self, client: int) -> None:
        if client == self._grabber:
            self._let_go()

    def _let_go(self) -> None:
        self._grab = self._grabber = None
        if self.simulation is not None:
            self.simulation.release()

    def _begin_loading(self, name: str, task: Mapping[str, Any] | None) -> None:
        """Shows the scene, and compiles in another thread."""
        same = self.simulation is not None and name == self.name and task is None
        if same and self._loading is None:
            return
        self._let_go()
        began = (name, time.perf_counter())
        self._loading, self.note = began, ""
        threading.Thread(
            target=self._load,
            args=(began, name, dict(task or {})),
            daemon=True,
            name="compiling",
        ).start()

    def _load(self, began: tuple[str, float], name: str, task: dict[str, Any]) -> None:
        try:
            run = find_run(name)
            program = Program(run, task)
            program = self._programs.setdefault(program.identity, program)
            self._queue.put(lambda: self._set_stage(began, program))
            if not program.ready:
                program.compile(run)
            simulation = Simulation(run, program, seed=self.seed)
            simulation.warm_up()
        except Exception as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            self._queue.put(lambda: self._failed(began, reason[:200]))
        else:
            self._queue.put(lambda: self._loaded(began, simulation))

    def _set_stage(self, began: tuple[str, float], program: Program) -> None:
        if began is self._loading:
            self._stage = Stage(self.server, program.environment, self._dragged)
            self._stage.set_plain(self.looks.plain)
            self._stage.still(program.first_qpos)
            self.simulation = None

    def _failed(self, began: tuple[str, float], reason: str) -> None:
        if began is self._loading:
            self._loading = None
            self.note = f"**{reason}**"
            if self.simulation is not None:
                self.panel.policy.value = self.name

    def _loaded(self, began: tuple[str, float], simulation: Simulation) -> None:
        if began is not self._loading:
            return
        low, high = simulation.run.alphas
        alpha = max(low, min(high, FIRST_ALPHA))
        if self._alpha is not None:
            alpha, self._alpha = self._alpha, None
        if alpha != simulation.alpha:
            simulation.alpha = alpha
            simulation.reset(episode=0)
        self.name, self.simulation, self._loading = began[0], simulation, None
        while len(self._programs) > PROGRAMS:
            self._programs.pop(next(iter(self._programs)))
        self.panel.policy.value = self.name
        self.panel.of_policy(simulation)

    def _show_plots(self) -> None:
        if self.simulation is not None:
            self.panel.plots.show(self.simulation.history)

    def _show_status(self) -> None:
        self.panel.status.content = self.status_text()

    def status_text(self) -> str:
        """What the page says at its top."""
        loading = None
        if self._loading is not None:
            name, since = self._loading
            loading = name, time.perf_counter() - since
        return status.text(
            self.note,
            loading,
            self.simulation,
            self.real_time_factor,
            self._meter.wanted,
        )

    def _save(
        self, simulation: Simulation, moments: list, kind: str, alpha: float
    ) -> None:
        try:
            path = saving.save(simulation, moments, kind, alpha, self.out)
            self.note = status.plain(f"saved {path}")
            self.server.send_file_download(path.name, path.read_bytes())
        except Exception as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            self.note = status.bold(f"not saved: {reason[:200]}")
