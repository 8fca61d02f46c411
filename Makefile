# `make demo` runs the whole pipeline with the demo preset, `make test` the tests. Both install what they need.
# Needs: Python 3.12 within reach (or the network, where uv can fetch one) and git.
SHELL := /bin/bash
# A uv on the path counts only where it runs: version managers leave shims that answer "not found".
UV := $(shell uv --version >/dev/null 2>&1 && echo uv || echo .bootstrap/bin/uv)
RUN := $(UV) run --frozen
# Where the environment sets this (many containers), every process compiles its imports again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo docs wheels test test-slow lint install install-scale record clean

demo: install
	$(RUN) worldline pipeline --preset demo

# Temporary files of tests lie in memory where it has 4 GB for them: artifacts are flushed to the disk thousands of times.
in_memory = $(shell df -kP /dev/shm 2>/dev/null | awk 'NR == 2 && $$4 > 4e6 {print "-p /dev/shm"}')

# One process per core, one thread each; neighbours stay together, so that what a file sets up is set up once.
test: install-scale
	@export TMPDIR=$$(mktemp -d $(in_memory)); trap 'rm -rf "$$TMPDIR"' EXIT; \
	OMP_NUM_THREADS=1 $(RUN) pytest -n auto --dist worksteal

# What takes long (CONTRIBUTING.md): servers, processes, trainings, the rehearsal of the full size, wheels. Two at a time, a file
# in one process: several of them start processes of their own, and share what takes a minute to set up.
test-slow: install-scale
	OMP_NUM_THREADS=1 $(RUN) pytest -m slow -n 2 --dist loadfile --no-loadscope-reorder --timeout=900

lint: install-scale
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) lint-imports
	$(RUN) pyright

install: $(filter .bootstrap/bin/uv,$(UV))
	$(UV) sync --frozen --inexact --extra sim

install-scale: install
	$(UV) sync --frozen --inexact --extra sim --group scale

.bootstrap/bin/uv:
	python3 -m venv .bootstrap || { echo "Install Python's venv (Debian: apt-get install python3-venv), or uv (https://docs.astral.sh/uv)"; rm -rf .bootstrap; exit 1; }
	.bootstrap/bin/pip install --quiet uv

# The recordings that the demo uses, made again from their seeds (needs software GL, see docs/recorded_worlds.md).
record: install
	$(RUN) worldline record --config configs/recording/sample.yaml --output artifacts/recorded

# The documentation as a site in site/; a dead link or a broken docstring ends it.
docs: $(filter .bootstrap/bin/uv,$(UV))
	$(UV) run --frozen --isolated --only-group docs mkdocs build

# The package, and the shipped recordings and models as a second one: pip install worldline[assets] --find-links dist
wheels: install
	$(UV) build --wheel --out-dir dist .
	$(UV) build --wheel --out-dir dist packaging/assets

clean:
	rm -rf .bootstrap .venv
