# make run    train the cart-pole on three nodes of this machine (the first time: environment and kernels too)
# make test   lint and the whole test suite
# make torture N=300   kill everything at random moments; every run must end with the same bits
# make bits            every proof that a resumed run ends with the same bits (make test has most of them)
# make fuzz N=10000    malformed requests, drawn at random; none may be answered with a 500
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready

.PHONY: run test lint format bench bench-gpu bench-api bench-scheduling bench-logs bench-resume bits fuzz torture env clean

run: $(READY)
	$(BIN)/muster run job_specs/cartpole.yaml

test: lint
	$(BIN)/python -m tests.kernels
	$(BIN)/pytest -q -n 2 --dist loadfile --durations=10

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# the spine, and what training makes of this machine's processor: cpu.md, curves_cpu.md
bench: $(READY)
	$(BIN)/python -m benchmarks.spine
	$(BIN)/python -m benchmarks.training
	$(BIN)/python -m benchmarks.curves

bench-scheduling: $(READY)
	$(BIN)/python -m benchmarks.scheduling | tee benchmarks/scheduling.md

bench-logs: $(READY)
	$(BIN)/python -m benchmarks.log_follow | tee benchmarks/log_follow.md

bench-resume: $(READY)
	$(BIN)/python -m benchmarks.resume

# needs CUDA devices: all tables, with as many GPUs as there are
bench-gpu: $(READY)
	$(BIN)/python -m benchmarks.training --sweep Ant Humanoid
	$(BIN)/python -m benchmarks.curves
	$(BIN)/python -m benchmarks.scaling

bench-api: $(READY)
	$(BIN)/python -m benchmarks.api

torture: $(READY)
	$(BIN)/python -m tests.faults.torture --kills $(or $(N),300)

bits: $(READY)
	MUSTER_LONG=1 $(BIN)/pytest -q tests/faults/test_bits.py tests/engines

fuzz: $(READY)
	MUSTER_FUZZ=$(or $(N),10000) $(BIN)/pytest -q tests/conformance/test_fuzz.py

env: $(READY)

# torch first and alone: an environment that has it installs nothing more for the packages that want it
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Muster needs Python 3.11 or newer; set PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt --editable '.[worker,aws,dev]'
	touch $(READY)

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache
