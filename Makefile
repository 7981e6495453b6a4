# Every target sets up what it needs: uv into .tools/, all packages into .venv/, missing system libraries into
# .venv/syslibs/. Nothing outside this folder is changed, and nothing needs root. `make help` lists the targets.

SHELL := /bin/bash
.DEFAULT_GOAL := help

PYTHON ?= python3
PYTHONS ?= 3.11 3.12 3.13
READY := .venv/.ready
KERNELS := $(wildcard semantic_mapper/kernels/src/*)

# Two test processes, with one thread of computation each. A worker that crashes ends the run with an error.
TESTS := .venv/bin/python -m pytest tests -n 2 --dist worksteal --max-worker-restart 0
PYTEST := OMP_NUM_THREADS=1 $(TESTS)

# Without bytecode, each process that a test starts would compile its packages again: seconds of CPU.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup slim demo test test-loaded test-gate test-matrix test-slow test-research nightly test-v4l2 test-web check bench wheels docs format lock clean

help:  ## list the targets
	@sed -n 's/^\([a-z0-9-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 10

setup: $(READY)  ## make .venv as uv.lock says, with everything that Open3D needs

$(READY): pyproject.toml uv.lock setup.py $(KERNELS) tools/setup.sh tools/system_libs.py
	PYTHON=$(PYTHON) tools/setup.sh
	@touch $@

slim:  ## make .venv with what mapping needs, without PyTorch and developers' tools
	PYTHON=$(PYTHON) tools/setup.sh --slim

demo: $(or $(wildcard .venv/.slim),$(READY))  ## map an embedded scene; results in runs/demo
	.venv/bin/semantic-mapper demo --out runs/demo

test: $(READY)  ## run the quick tests
	$(PYTEST) -m "not slow"

test-loaded: $(READY)  ## run the quick tests next to two busy processes, then on one thread with a limit on CPU time
	env -u OMP_NUM_THREADS .venv/bin/python -m tools.beside_load 2 $(TESTS) -m "not slow"
	$(PYTEST) -m "not slow" --cpu-limit 6

test-gate: $(READY)  ## run the three slow tests of the gate: lockstep, a crash, a finetuning
	$(PYTEST) -m gate

test-slow: $(READY)  ## run the slow tests: crash rounds, launches, learning, training
	$(PYTEST) -m slow

test-research: $(READY)  ## run the tests of research/
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest research/tests -n 2 --dist worksteal --max-worker-restart 0

nightly: $(READY)  ## run all tests, those of research, and everything on bare machines and with other Pythons
	$(PYTEST)
	$(MAKE) test-research
	tools/bare_machine.sh "make demo && make test"
	tools/bare_machine.sh --suite forky "make demo && make test"
	$(MAKE) test-matrix
	tools/bare_machine.sh "make slim && du -sm .venv && make demo && .venv/bin/semantic-mapper doctor"

test-matrix: $(READY)  ## run the quick tests with each of PYTHONS, with the oldest packages and the newest
	tools/test_matrix.sh $(PYTHONS)

test-v4l2: $(READY)  ## run the V4L2 driver against Debian's kernel with a virtual camera, in QEMU
	.venv/bin/python -m research.experiments.v4l2_machine

test-web: $(READY)  ## try the labelling page in a headless browser
	.venv/bin/python -m tests.browser
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest tests/nodes/labeller/test_page.py

check: $(READY)  ## formatting, lint, types, import contracts, uv.lock against pyproject.toml
	.tools/bin/uv lock --check --quiet
	.venv/bin/ruff format --check .
	.venv/bin/ruff check .
	.venv/bin/pyright
	.venv/bin/lint-imports --no-logo

bench: $(READY)  ## measure speed
	.venv/bin/semantic-mapper bench

wheels: $(READY)  ## build wheels for x86_64 and aarch64 into dist/, and check them
	.venv/bin/python -m tools.wheels

docs: $(READY)  ## build the site of all pages into dist/docs/; broken links are errors
	.venv/bin/python -m sphinx -c docs -b html -q -E -W --keep-going . dist/docs
	@echo "open dist/docs/README.html"

format: $(READY)  ## format and fix what can be fixed automatically
	.venv/bin/ruff format .
	.venv/bin/ruff check --fix .

lock: $(READY)  ## write uv.lock again after a change of dependencies
	.tools/bin/uv lock

clean:  ## remove everything that the targets made, except runs/
	rm -rf .venv .tools build dist *.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache
