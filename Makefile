# make run    train the cart-pole on three nodes of this machine (the first time: environment and kernels too)
# make race             train a car until it drives laps, evaluate it, film it: minutes on two cores
# make test   lint, the unit tests, and every command of the README for real: minutes
# make check            everything: the tiers below, whose tests also run alone, two lanes beside each other
# make unit integration training long robots services console engines    one tier of tests; docs/contributing.md says what each is
# make without-racer    the suite once without the racer's package; TESTS="tests/unit tests/integration" by default
# make torture N=300   kill everything at random moments: every run must end with the same bits; then hostile jobs, full disks, clocks, outages
# make bits            every proof that a resumed run ends with the same bits (make test has most of them)
# make mutants          small faults in the pure modules: which ones do the unit tests not notice?
# make cluster NODES=3 a controller, a Ray head and three workers in containers; make cluster-down
# make kernels-pack      build/kernels/muster_kernels-….whl: compiled kernels for GPUs, which first trainings need not compile
# make coverage TESTS=tests/unit   the branches of control, engines and learning that these tests never enter
# make fuzz N=10000    malformed requests and hostile clients; no answer may be a 500, and others must be served meanwhile
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready

# where it is set, every process would compile all that it imports anew: twice the time of a start
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run race test check coverage unit integration training long robots services console engines quick rest without-racer kernels kernels-pack robots-kernels tracking lint format bench bench-gpu bench-api bench-scheduling bench-logs bench-health bench-resume bench-engines bench-startup bench-console bits fuzz mutants torture env image push cluster cluster-down clean

run: $(READY)
	$(BIN)/muster run job_specs/cartpole.yaml

# faster laps: make race ITERATIONS=300
race: $(READY)
	run=$$($(BIN)/muster run job_specs/racer.yaml --set train.iterations=$(or $(ITERATIONS),100) | tee /dev/stderr | sed -n '/^SUCCEEDED/,$$s/^  run: *//p') && test -n "$$run" && \
	$(BIN)/muster evaluate $$run --episodes 64 && \
	$(BIN)/muster render $$run -o race.gif --overwrite --worlds 1 --seconds 12 --size 320x240 && \
	echo "run $$run; its reward plot is above, its film: $(CURDIR)/race.gif"

# two files at a time: tests/support/suite/lanes.py; what each test cost is left in build/tests
PYTEST = $(BIN)/python -m pytest -q -n 2 --durations=40 --junitxml build/tests/$@.xml

# the kernels of the README's tasks are compiled before; lint runs beside the tests
test: $(READY)
	$(BIN)/python -m tests.support.suite.kernels Cartpole Racer
	$(MAKE) --no-print-directory --jobs 2 lint quick

quick: $(READY)
	$(PYTEST) tests/unit tests/cluster/test_readme.py

check: $(READY) tracking kernels robots-kernels
	$(MAKE) --no-print-directory test
	$(MAKE) --no-print-directory rest
	$(MAKE) --no-print-directory without-racer TESTS="$(ONCE_WITHOUT_RACER)"

# clusters and browsers are one lane, all else is the other
rest: $(READY)
	$(PYTEST) tests --ignore tests/unit --ignore tests/cluster/test_readme.py

# a copy of this clone in build/without-racer, whose environment never had the package
without-racer: $(READY)
	$(BIN)/python -m tests.support.suite.without_racer $(TESTS)

# what reaches plug-ins: specs, services, the store, the command and the pages
ONCE_WITHOUT_RACER = $(addprefix tests/unit/,orchestrator/spec orchestrator/console orchestrator/cli shared_store test_packages.py) \
    $(addprefix tests/unit/worker/test_,evaluation.py interface.py task_configs.py) \
    $(addprefix tests/integration/,conformance/test_permissions.py console/test_submit.py orchestrator/test_cli.py orchestrator/test_evaluate.py)

unit integration: $(READY)
	$(PYTEST) tests/$@

training long: $(READY) kernels
	$(PYTEST) tests/$@

robots: $(READY) robots-kernels
	$(PYTEST) tests/robots

services: $(READY) kernels tracking
	$(PYTEST) tests/training/worker/test_tracking.py tests/unit/worker/test_export.py tests/training/racer/test_sim_trace.py

# pictures of the pages are left in build/console
console: $(READY) kernels
	$(PYTEST) tests/console

# one after the other: no two clusters run at once
engines: $(READY) kernels
	$(PYTEST) -n 0 tests/cluster

# branches that no test of TESTS enters
coverage: $(READY) kernels
	rm -rf build/coverage
	$(BIN)/coverage run -m pytest -q $(or $(TESTS),tests/unit) || echo "tests failed: the figures are of what ran"
	$(BIN)/coverage combine -q && $(BIN)/coverage report --show-missing --skip-covered

# kept in the user's cache, for other clones and later runs
kernels: $(READY)
	$(BIN)/python -m tests.support.suite.kernels

# a wheel of compiled kernels for GPUs, made without one; TASKS="Ant Humanoid" TARGETS=sm90 narrow it. Copied to containers/wheels,
# it becomes part of the image
kernels-pack: $(READY)
	$(BIN)/python -m worker.kernels pack $(TASKS) $(if $(TARGETS),--targets $(TARGETS))

robots-kernels: $(READY)
	$(BIN)/python -m tests.support.suite.kernels Go1Flat G1Flat Go1Rough LiftCube LiftCubes

# W&B, MLflow and LEAPP (130 MB); pandas for MLflow's own server, which the extra has without it; deepracer-utils, which reads SimTrace files
tracking: $(READY)
	$(BIN)/python -c 'import wandb, mlflow, leapp, pandas, deepracer' 2>/dev/null || $(BIN)/pip install --quiet --no-compile --no-warn-conflicts --disable-pip-version-check --constraint constraints.txt --editable '.[wandb,mlflow,leapp]' --editable ./racer pandas deepracer-utils

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m docs.tools.plain_words

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# the spine, and what training makes of this machine's processor: cpu.md, curves_cpu.md; a loaded machine is refused
bench: $(READY)
	$(BIN)/python -m benchmarks.spine
	$(BIN)/python -m benchmarks.processor

bench-scheduling: $(READY)
	$(BIN)/python -m benchmarks.scheduling | tee benchmarks/scheduling.md

bench-logs: $(READY)
	$(BIN)/python -m benchmarks.log_follow | tee benchmarks/log_follow.md

bench-health: $(READY)
	$(BIN)/python -m benchmarks.health | tee benchmarks/health.md

bench-engines: $(READY)
	$(BIN)/python -m pytest -q -s -p tests.support.engines.fixtures benchmarks/engines.py

bench-startup: $(READY)
	$(BIN)/python -m benchmarks.startup

# the console's pages; and, in an environment that is made for it, the same table in NiceGUI
bench-console: $(READY)
	$(BIN)/python -m benchmarks.console
	$(BIN)/python -m benchmarks.console_stack

bench-resume: $(READY)
	$(BIN)/python -m benchmarks.resume

# needs CUDA devices: all tables, with as many GPUs as there are
bench-gpu: $(READY)
	$(BIN)/python -m benchmarks.training --sweep Ant Humanoid
	$(BIN)/python -m benchmarks.curves
	$(BIN)/python -m benchmarks.scaling
	$(BIN)/python -m benchmarks.loops
	$(BIN)/python -m benchmarks.saving
	$(BIN)/python -m benchmarks.tasks
	$(BIN)/python -m benchmarks.objective

bench-api: $(READY)
	$(BIN)/python -m benchmarks.api

torture: $(READY)
	$(BIN)/python -m tests.support.faults.torture --kills $(or $(N),300) --rounds $(or $(ROUNDS),10)

bits: $(READY)
	MUSTER_LONG=1 $(BIN)/pytest -q tests/training/faults/test_bits.py tests/long/faults/test_bits_of_algorithms.py tests/training/e2e tests/integration/engines/test_several.py tests/training/engines

fuzz: $(READY)
	MUSTER_FUZZ=$(or $(N),10000) $(BIN)/pytest -q tests/integration/conformance/test_fuzz.py tests/integration/conformance/test_hostile_clients.py

# MODULES="orchestrator.domain.job*" narrows it
mutants: $(READY)
	$(BIN)/pip install -q -c constraints.txt mutmut==3.8.1
	$(BIN)/mutmut run $(MODULES)
	$(BIN)/mutmut results | sed '/not checked/d'

env: $(READY)

# .ci/environment keeps what it installs in the user's cache
$(READY): pyproject.toml racer/pyproject.toml policy_node/pyproject.toml constraints.txt .ci/environment
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Muster needs Python 3.11 or newer; set PYTHON=python3.11")'
	.ci/environment $(PYTHON) $(VENV)
	touch $(READY)

# the image, and a cluster of containers of it: containers/compose.yaml
NODES     ?= 3
EXTRAS    ?= worker,ray
IMAGE     ?= muster
BUILD     ?=
REVISION  := $(shell git rev-parse HEAD 2>/dev/null)
COMPOSE    = $(shell docker compose version >/dev/null 2>&1 && echo docker compose || echo docker-compose) \
             --project-name muster --env-file $(CURDIR)/.cluster/environment -f containers/compose.yaml
# as compose itself looks for it
PORT       = $(or $(MUSTER_PORT),$(shell sed -n 's/^MUSTER_PORT=//p' .cluster/environment),8080)

image:
	docker build -f containers/Dockerfile -t $(IMAGE) --build-arg EXTRAS=$(EXTRAS) --build-arg REVISION=$(REVISION) $(BUILD) .

push:
	@test -n "$(REGISTRY)" || { echo "make push needs REGISTRY, such as REGISTRY=registry.example.com:5000/robots" >&2; exit 2; }
	@docker image inspect $(IMAGE) >/dev/null 2>&1 || { echo "there is no image $(IMAGE); make image builds it" >&2; exit 2; }
	version=$$(docker image inspect -f '{{index .Config.Labels "org.opencontainers.image.version"}}' $(IMAGE)) && \
	for tag in $$version latest; do \
	  docker tag $(IMAGE) $(REGISTRY)/muster:$$tag && docker push $(REGISTRY)/muster:$$tag || exit 1; done

.cluster/environment:
	mkdir -p .cluster
	umask 077; random() { od -An -N24 -tx1 /dev/urandom | tr -d ' \n'; }; \
	printf 'RAY_AUTH_TOKEN=%s\nMUSTER_TOKEN=%s\nMUSTER_WORK=%s\n' "$$(random)" "$$(random)" "$(CURDIR)" >$@

# Refused before anything is started: a port that something else than this cluster's own controller has.
# The image is always built: one of that name may be of older files, or without Ray; what has not changed is in Docker's cache.
cluster: .cluster/environment
	@if ! docker ps --quiet --filter label=com.docker.compose.project=muster --filter publish=$(PORT) | grep -q . \
	  && command -v $(PYTHON) >/dev/null \
	  && ! $(PYTHON) -c 'import socket; socket.create_server(("127.0.0.1", int("$(PORT)")))' 2>/dev/null; then \
	  echo "port $(PORT) of this machine is taken (does muster serve run?); choose another: make cluster MUSTER_PORT=8081" >&2; exit 2; fi
	$(MAKE) image
	MUSTER_IMAGE=$(IMAGE) $(COMPOSE) up --detach --scale worker=$(NODES)
	@echo "waiting for the controller"; for i in $$(seq 60); do \
	  $(COMPOSE) exec -T controller sh /muster/cluster.sh healthy 2>/dev/null && break; \
	  test $$i -lt 60 || { $(COMPOSE) logs --tail=20; echo "the controller does not answer; its log is above" >&2; exit 1; }; sleep 2; done
	@echo "It is up. For muster on this machine:"
	@echo "  export MUSTER_URL=http://127.0.0.1:$(PORT) $$(grep MUSTER_TOKEN .cluster/environment)"

cluster-down: .cluster/environment
	$(COMPOSE) down $(if $(VOLUMES),--volumes)

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache
