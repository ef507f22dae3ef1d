"""What a trained policy looks like: `python -m dcc_jax.render RUN_DIR`."""
