# make train | make test on a machine that has only Python 3.11 to 3.13, make, git and a package registry.
# Everything is installed into .venv; `make install` is repeated only when the lock or pyproject.toml changes.

.DEFAULT_GOAL := help
.PHONY: help install train test test-long test-slow test-gpu test-newer-jax test-faults test-faults-long check check-web browser vendor glossary format lock docs bench-engine bench-engine-peers bundle clean
.SUFFIXES:

# Choose the interpreter with `make PYTHON=/path/to/python3.12 ...`; empty: the first of python3.12, 3.13, 3.11, python3
# that works and is supported.
PYTHON ?=
# Test processes, one more than two cores have: some of the tests wait for a browser, for Ray or for other processes.
# They share one JAX compile cache, so that the second run is short.
TEST_WORKERS ?= 3
# A file stays in one process. One that ends, by a crash or by a test that waited for ever, is begun again once.
PROCESSES := -n $(TEST_WORKERS) --dist loadfile --no-loadscope-reorder --max-worker-restart 1
# Those of tests for a GPU, which share its memory.
GPU_TEST_WORKERS ?= 2
# More options for pytest, e.g. PYTEST_ARGS="-k pendulum -x"
PYTEST_ARGS ?=
# More options for train, e.g. TRAIN_ARGS="--run runs/mine"
TRAIN_ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

help:
	@echo "make train         install, then pretrain, fine-tune and draw on two CPU cores, minutes"
	@echo "make test          install, then lint, types and tests        (test-long, test-slow, test-gpu: the rest)"
	@echo "make test-newer-jax  tests that lean on JAX most, under Python 3.12 and its newer JAX, on two virtual devices"
	@echo "make test-faults   install, then the slow tests of runs: losses at random times, stops, kills; all on the CPU"
	@echo "make test-faults-long  install, then 50 kills, and a fault every 30 s for ten minutes; an hour, runs/faults/*.json"
	@echo "make check-web     the pages' scripts through the type checker of TypeScript  (from the npm registry)"
	@echo "make browser       a headless Chromium for tests of the pages                (from the npm registry)"
	@echo "make vendor        renew the libraries that the pages use"
	@echo "make glossary      renew the glossary of the pages from docs/glossary.md"
	@echo "make check         install, then ruff and the type checker only"
	@echo "make install       .venv with the pinned packages and this one (editable)"
	@echo "make bench-engine  physics steps per second on this machine   (bench-engine-peers: next to the published engine)"
	@echo "make docs          the pages as a site, in dist/docs"
	@echo "make bundle        everything an installation needs, in dist/bundle, for machines without a network (EXTRA=cuda13)"
	@echo "make lock          renew requirements.lock from pyproject.toml"

install: $(STAMP)

$(STAMP): requirements.lock pyproject.toml .ci/install
	@PYTHON="$(PYTHON)" bash .ci/install "$(VENV)"
	@touch "$(STAMP)"

train: $(STAMP)
	$(BIN)/kinetix-dist quickstart $(TRAIN_ARGS)

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python .ci/check_types.py

# The web pages: their type checker and the browser that tests them come from the npm registry, into .cache.
WEB := .cache/web
WEB_STAMP := $(WEB)/.installed
BROWSER := .cache/browser
STATIC := kinetix_dist/studio/static

$(WEB_STAMP): .ci/web/package.json .ci/web/package-lock.json .ci/web/install | $(STAMP)
	@bash .ci/web/install "$(VENV)" "$(WEB)"

check-web: $(WEB_STAMP)
	PATH="$(abspath $(WEB)):$$PATH" $(WEB)/node_modules/.bin/tsc -p $(STATIC)/jsconfig.json

browser: $(BROWSER)/chromium

$(BROWSER)/chromium: $(WEB_STAMP) .ci/web/unpack_chromium.mjs
	$(WEB)/node .ci/web/unpack_chromium.mjs "$(WEB)/node_modules" "$(BROWSER)"
	@touch "$(BROWSER)/chromium"

vendor: $(WEB_STAMP)
	$(BIN)/python .ci/web/vendor.py "$(WEB)/node_modules"

glossary: $(STAMP)
	$(BIN)/python .ci/web/glossary.py

format: $(STAMP)
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

test: check
	$(BIN)/python -m pytest $(PROCESSES) $(PYTEST_ARGS)

# Continuous integration runs these too.
test-long: $(STAMP)
	$(BIN)/python -m pytest -m "long and not slow and not gpu" $(PROCESSES) $(PYTEST_ARGS)

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m "slow and not gpu" -o faulthandler_timeout=0 $(PYTEST_ARGS)

# One after another, each with its figures: times of recovery are measured.
test-faults: $(STAMP)
	$(BIN)/python -m pytest tests/runtime -m "slow and not gpu" -o faulthandler_timeout=0 -s $(PYTEST_ARGS)

# Both placements, compared bit for bit with runs without a fault.
test-faults-long: $(STAMP)
	$(BIN)/python -m bench.fault_tests --placement colocated split --kills 50 --json runs/faults/kills.json
	$(BIN)/python -m bench.fault_tests --placement colocated split --every 30 --seconds 600 --json runs/faults/every_30_s.json

test-gpu: $(STAMP)
	$(BIN)/python -m pytest -m gpu -n $(GPU_TEST_WORKERS) --dist loadfile $(PYTEST_ARGS)

# The lock has a newer JAX for Python 3.12 than for 3.11: what leans on JAX most, with two devices that are both this CPU.
# An environment of its own is made for it in .cache.
NEWER_PYTHON ?= python3.12
NEWER := .cache/newer
NEWER_STAMP := $(NEWER)/.installed
NEWER_TESTS := tests/runtime/test_programs.py tests/runtime/test_recurrent.py tests/learner/test_update.py \
	tests/actors/test_unroll.py tests/actors/test_invariants.py tests/engine/test_vmap.py \
	tests/engine/test_packed_states.py tests/env/test_stepper.py tests/models/test_kernels.py tests/models/test_cuda_kernels.py \
	tests/level/test_generator_program.py

$(NEWER_STAMP): requirements.lock pyproject.toml .ci/install
	@mkdir -p .cache
	@PYTHON="$(NEWER_PYTHON)" bash .ci/install "$(NEWER)"
	@touch "$(NEWER_STAMP)"

test-newer-jax: $(NEWER_STAMP)
	JAX_NUM_CPU_DEVICES=2 JAX_COMPILATION_CACHE_DIR=.cache/newer-jax $(NEWER)/bin/python -m pytest $(NEWER_TESTS) $(PYTEST_ARGS)

bench-engine: $(STAMP)
	$(BIN)/kinetix-dist bench engine speed --json runs/bench_engine.json

bench-engine-peers: $(STAMP)
	bash bench/peers/setup.sh
	$(BIN)/kinetix-dist bench engine speed --peers --json runs/bench_engine.json

# The lock holds versions and hashes only: whoever installs chooses the registry.
lock: $(STAMP)
	$(BIN)/uv pip compile pyproject.toml --extra dev --extra wrappers --extra tensorboard --extra docs --universal --python-version 3.11 --generate-hashes \
		--no-header --no-annotate --upgrade --output-file requirements.lock

# For machines of the same Python, system and processor that have no network: bash dist/bundle/install.sh VENV
BUNDLE ?= dist/bundle
EXTRA ?=
bundle: $(STAMP)
	PYTHON=$(BIN)/python bash cluster/bundle.sh "$(BUNDLE)" $(EXTRA)

# The pages as a site, from the files alone: dist/docs/html/docs/index.html. A link that leads nowhere is an error.
SITE := dist/docs
docs: $(STAMP)
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet --builder html --conf-dir docs . "$(SITE)/html" --doctree-dir "$(SITE)/doctrees"
	@echo "made $(SITE)/html/docs/index.html"

clean:
	rm -rf $(VENV) .cache .pytest_cache .ruff_cache
