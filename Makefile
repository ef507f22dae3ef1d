# `make test` and `make run` work on a fresh machine: they create .venv and install.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# `make run`: about five minutes of learning on two cores, at levels of compliance that
# are learned in that time (0.16 takes half an hour).
RUN := runs/trampoline-$(shell date +%Y%m%d-%H%M%S)
TUPLES := 1638400
LEVELS := --env.alpha 0 --env.alpha-max 0.04

.PHONY: setup run test test-all check clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet -c constraints.txt -e ".[dev,video]"
	touch $(STAMP)

run: setup
	$(BIN)/python -m dcc_jax.train --task trampoline $(LEVELS) --train.total-tuples $(TUPLES) --run-dir $(RUN)
	$(BIN)/python -m dcc_jax.render $(RUN) --seconds 12 --out $(RUN)/policy.mp4
	@echo "curves: $(RUN)/curves.png   video: $(RUN)/policy.mp4   go on: \
	$(BIN)/python -m dcc_jax.train --task trampoline $(LEVELS) --resume --run-dir $(RUN)"

test: setup
	$(BIN)/python -m pytest -n auto --dist loadfile

test-all: setup
	$(BIN)/python -m pytest -m "slow or not slow" -n auto --dist loadfile

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache
