"""What a run leaves to read: `metrics.jsonl`, TensorBoard, one line of progress."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.text import Text

WALL_CLOCK = ("seconds", "tuples_per_second", "devices")
"""Fields of `metrics.jsonl` that tell of the machine, not of the run.

All others are the same, bit for bit, whether a run was interrupted or not.
"""

_LINE_EVERY = 10.0  # s between lines where there is no terminal to redraw


class RunLog:
    """The files of one run, cut back to the update from which it continues."""

    def __init__(self, run_dir: Path, update: int) -> None:
        """Opens them.

        Args:
            run_dir: of the run.
            update: updates done; what is logged of later ones is dropped.
        """
        self._path = run_dir / "metrics.jsonl"
        _truncate(self._path, update)
        self._file = self._path.open("a")
        # Here because it changes the environment of the process that imports it.
        from tensorboardX import SummaryWriter

        self._board = SummaryWriter(
            str(run_dir / "tensorboard"), purge_step=update + 1, flush_secs=30
        )

    def write(self, metrics: dict[str, float]) -> None:
        """Appends one update; a number that is not finite becomes null."""
        finite = {k: v if math.isfinite(v) else None for k, v in metrics.items()}
        self._file.write(json.dumps(finite) + "\n")
        self._file.flush()
        step = int(metrics["update"])
        for name, value in metrics.items():
            if name != "update":
                self._board.add_scalar(name, value, step)

    def close(self) -> None:
        self._file.close()
        self._board.close()


def read(run_dir: Path) -> list[dict[str, float]]:
    """The metrics of a run, one entry an update."""
    lines = (run_dir / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


class Progress:
    """One live line on a terminal, a line now and then anywhere else."""

    def __init__(self, total_tuples: int, quiet: bool = False) -> None:
        self._total = total_tuples
        self._quiet = quiet
        self._console = Console(file=sys.stderr, highlight=False)
        live = self._console.is_terminal and not quiet
        self._live = Live(console=self._console, transient=True) if live else None
        self._printed = -math.inf

    def __enter__(self) -> Progress:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, message: str) -> None:
        """Prints a sentence above the line."""
        if not self._quiet:
            self._console.print(message, markup=False, soft_wrap=True)

    def show(self, metrics: dict[str, float]) -> None:
        """Shows how the run is doing."""
        line = progress_line(metrics, self._total)
        if self._live is not None:
            self._live.update(Text(line, no_wrap=True, overflow="ellipsis"))
        elif time.monotonic() - self._printed > _LINE_EVERY:
            self._printed = time.monotonic()
            self.say(line)


def progress_line(metrics: dict[str, float], total: int) -> str:
    """Update, tuples, speed, time left, reward and its parts, episodes, D."""
    rate = metrics["tuples_per_second"]
    left = max(0.0, total - metrics["tuples"]) / max(rate, 1e-9)
    imitation = "adversarial" if "disc/accuracy_real" in metrics else "tracking"
    return (
        f"update {metrics['update']:.0f}  "
        f"{metrics['tuples'] / 1e6:.2f}/{total / 1e6:.2f} M tuples  "
        f"{rate:,.0f}/s  {_clock(left)} left  "
        f"r {metrics['reward/total']:.3f} "
        f"({imitation} q {metrics['reward/r_q']:.2f} p {metrics['reward/r_p']:.2f} "
        f"task {metrics['reward/r_task']:.2f})  "
        f"episode {metrics['episode/length']:.0f} steps, "
        f"falls {metrics['episode/fall_rate']:.0%}" + _of_discriminator(metrics)
    )


def _of_discriminator(metrics: dict[str, float]) -> str:
    """Shares it judged right; nothing for a task that follows its clip in time."""
    if "disc/accuracy_real" not in metrics:
        return ""
    real, fake = metrics["disc/accuracy_real"], metrics["disc/accuracy_fake"]
    return f"  D {real:.0%}/{fake:.0%}"


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"


def _truncate(path: Path, update: int) -> None:
    """Keeps the lines up to an update; one that a kill cut short goes as well."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text().splitlines(keepends=True):
        try:
            if not line.endswith("\n") or json.loads(line)["update"] > update:
                break
        except (ValueError, KeyError, TypeError):
            break
        kept.append(line)
    partial = path.with_suffix(".partial")
    partial.write_text("".join(kept))
    os.replace(partial, path)
