"""`python -m dcc_jax.train`: trains a policy; `--help` lists every option.

The loop itself is in `dcc_jax.training.loop`. This file imports nothing heavy before
`runtime.import_jax()` has chosen how much jax says.
"""

from __future__ import annotations

import contextlib
import sys
import traceback
from collections.abc import Sequence

from dcc_jax import command, runtime
from dcc_jax.training import curves

PROGRAM = "dcc_jax.train"


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    try:
        runtime.import_jax()
        from dcc_jax import options
        from dcc_jax.training import loop

        said = options.parse(sys.argv[1:] if argv is None else argv)
        run = loop.prepare(said.config, said.run_dir, said.resume)
    # OSError: a run directory that cannot be made, a clip that cannot be opened.
    except (ValueError, OSError) as error:
        return command.complain(PROGRAM, str(error), 2)
    try:
        result = loop.execute(run)
        if result.metrics:
            curves.draw([result.run_dir], result.run_dir / "curves.png")
    except loop.RunError as error:
        return command.complain(PROGRAM, str(error), 1)
    except KeyboardInterrupt:
        return command.complain(
            PROGRAM, "interrupted twice; what was not saved is lost", 1
        )
    except Exception as error:
        log = run.run_dir / "error.log"
        with contextlib.suppress(OSError):
            log.write_text(traceback.format_exc())
        reason = (str(error).splitlines() or [""])[0][:200]
        return command.complain(
            PROGRAM, f"{type(error).__name__}: {reason} (details in {log})", 1
        )
    return 0


if __name__ == "__main__":
    command.leave(main())
