"""A policy live in a browser, to pull at: `dcc-jax view`. The only room with viser."""
