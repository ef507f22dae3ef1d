"""What a trained policy does, measured: `python -m dcc_jax.evaluate RUN_DIR`."""
