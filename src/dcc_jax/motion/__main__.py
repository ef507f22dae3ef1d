"""`dcc-jax motion import SRC... --out CLIP.npz`, `inspect` and `export`."""

from __future__ import annotations

from collections.abc import Sequence

from dcc_jax import command

PROGRAM = "dcc_jax.motion"
COMMANDS = {
    "import": ("dcc_jax.motion.retarget.command", "turn motion files into clips"),
    "inspect": ("dcc_jax.motion.inspect_command", "look at a clip"),
    "export": ("dcc_jax.export", "write a clip or what a policy does as BVH"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command; returns its exit status."""
    return command.choose(PROGRAM, COMMANDS, argv)


if __name__ == "__main__":
    command.leave(main())
