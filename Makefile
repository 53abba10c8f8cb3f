# Two commands do everything on a fresh machine: `make demo` and `make test`.

PYTHON ?= python3
BIN := .venv/bin
FOGSPEC := $(BIN)/fogspec
DEMO := specs/lidar-odometry.yaml
TEST_ARGS ?= -n 2

.DEFAULT_GOAL := help
.PHONY: help demo test lint types floors generated unit figures evaluation mutants lock clean

help:  ## say what there is
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

# Each stamp is the lock file that was installed last; the larger set contains the smaller at the same versions.
.venv/run.stamp: requirements/run.lock pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "setting up .venv (once)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/run.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $@

.venv/dev.stamp: requirements/dev.lock pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "setting up .venv for development (once; SkyPilot is large)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/dev.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $@ .venv/run.stamp

demo: .venv/run.stamp  ## the main job, here and now: real measurements, no account, no cloud
	$(FOGSPEC) validate $(DEMO)
	$(FOGSPEC) compile $(DEMO)
	$(FOGSPEC) bench $(DEMO) --runner local
	$(FOGSPEC) compile $(DEMO)
	$(FOGSPEC) explain $(DEMO)

test: lint types floors generated unit  ## everything that CI checks

lint: .venv/dev.stamp  ## style and common mistakes
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev.stamp  ## strict types
	$(BIN)/mypy

floors: .venv/dev.stamp  ## who may import whom
	$(BIN)/lint-imports

generated: .venv/dev.stamp  ## committed schemas, reference pages and compiled specs are what the code writes
	$(BIN)/python -m fogspec.effects.schemas --check
	$(FOGSPEC) compile specs/grasp-planning.yaml specs/vslam.yaml specs/motion-planning.yaml --check

# The language server that editors run; without npm its tests skip.
tests/editor/node_modules/.stamp: tests/editor/package-lock.json
	@if command -v npm >/dev/null; then npm ci --prefix tests/editor --silent --no-audit --no-fund && touch $@; fi

unit: .venv/dev.stamp tests/editor/node_modules/.stamp  ## tests with coverage
	$(BIN)/python -m pytest $(TEST_ARGS) --cov --cov-report=term:skip-covered

figures: .venv/dev.stamp  ## print every figure that README and docs quote
	$(BIN)/python -m tests.figures

# The development data are not in this repository; the layout is that of `fogspec evaluate --suite`.
FOGSPEC_SHARED ?= ../shared
evaluation: .venv/dev.stamp  ## every sampler and method over the development set, with priors and without (half an hour)
	$(FOGSPEC) evaluate --all --suite $(FOGSPEC_SHARED)/data/dev --priors $(FOGSPEC_SHARED)/data/priors
	$(FOGSPEC) evaluate --all --suite $(FOGSPEC_SHARED)/data/dev

mutants: .venv/dev.stamp  ## 100,000 damaged specs: what the diagnostics say of them (minutes)
	$(BIN)/python -m tests.mutation.survey

lock: .venv/dev.stamp  ## write the lock files anew from pyproject.toml
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --no-annotate --generate-hashes --all-extras pyproject.toml -o requirements/dev.lock
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --no-annotate --generate-hashes --extra local -c requirements/dev.lock pyproject.toml -o requirements/run.lock

clean:  ## remove what was set up here; measured and compiled files stay
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage* build dist
