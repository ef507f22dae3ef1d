# `make test` and `make run` work on a fresh machine: they create .venv and install.
# Another interpreter: `make test PYTHON=python3.13`.
PYTHON ?= python3
VERSION := $(shell $(PYTHON) -c "import sys; print('%d.%d' % sys.version_info[:2])")
# jax 0.11 and later, and numpy 2.5, need Python 3.12.
CONSTRAINTS := constraints/python$(if $(filter 3.11,$(VERSION)),3.11,3.13).txt
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed-$(VERSION)
# Another interpreter's packages go.
FRESH := $(if $(wildcard $(VENV)/lib/python$(VERSION)),,--clear)
# pip stops where there is no home directory, as under many service accounts.
HOME ?= $(CURDIR)/$(VENV)
export HOME
# `make run`: about three minutes of learning on two cores.
RUN := runs/door-$(shell date +%Y%m%d-%H%M%S)
LEARN := --task door --env.alpha 0 --env.alpha-max 0.8 --run-dir $(RUN)

# Tests that share a compiled program run on one worker (tests/conftest.py).
WORKERS := -n auto --dist loadgroup --no-loadscope-reorder

.PHONY: setup view run test test-browser test-all check clean

setup: $(STAMP)

$(STAMP): pyproject.toml $(CONSTRAINTS)
	$(if $(VERSION),,$(error PYTHON=$(PYTHON) is no Python interpreter))
	$(PYTHON) -m venv $(FRESH) $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet -c $(CONSTRAINTS) -e ".[dev,video,view]"
	touch $(STAMP)

# A character that walks and has learned to bear a pull. Another policy:
# `make view POLICY=door`, or a run directory.
POLICY ?= sustained-push
view: setup
	$(BIN)/python -m dcc_jax.view $(POLICY)

run: setup
	$(BIN)/python -m dcc_jax.train $(LEARN) --train.total-tuples 1638400
	$(BIN)/python -m dcc_jax.render $(RUN) --seconds 5 --out $(RUN)/policy.mp4
	@echo "curves: $(RUN)/curves.png   video: $(RUN)/policy.mp4   go on: \
	$(BIN)/python -m dcc_jax.train $(LEARN) --train.total-tuples 4000000 --resume"
	@echo "pull what was learned, in a browser:   make view POLICY=$(RUN)"

test: setup
	$(BIN)/python -m pytest $(WORKERS)

# The viewer in a Chromium that is installed; its pictures go to artefacts/.
test-browser: setup
	$(BIN)/python -m pytest -m browser tests/view/test_browser.py

test-all: setup
	DCC_JAX_TEST_OPTIMIZED=1 $(BIN)/python -m pytest \
	-m "(slow or not slow) and not browser" $(WORKERS)

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache
