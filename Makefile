# Everything runs in a virtual environment of its own, .venv; `make` alone lists what there is.
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
MAKEFLAGS += --no-print-directory
.DEFAULT_GOAL := help

PYTHON ?= python3
# Settings of one run, in TOML syntax: make ball_wall ARGS="num_samples=200 seed=1"
ARGS ?=
PYTEST_ARGS ?=

BIN := .venv/bin
EXPERIMENTS := $(sort $(basename $(notdir $(wildcard experiments/*.toml))))

# Compiling is most of the time of a first run; kept on disk, the second run starts at once.
export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/.cache/jax
export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS ?= 0
export JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES ?= -1

.PHONY: help setup demo test test-slow test-warp mujoco4 bench throughput engines costs rates gradient_audit identify-bench robots gallery docs lint clean $(EXPERIMENTS)

help:  ## list these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-14s %s\n", $$1, $$2}' $(firstword $(MAKEFILE_LIST))
	@echo
	@echo 'One target per experiments/*.toml; change its settings with ARGS="key=value ...":'
	@for name in $(EXPERIMENTS); do \
	    printf 'make %-14s %s\n' "$$name" "$$(sed -n '1s/^# *//p' "experiments/$$name.toml")"; done

setup: .venv/.installed  ## install the tested versions into .venv
	@echo 'Installed in .venv. Next: make demo, make test; make help lists the rest.'

.venv/.installed: pyproject.toml .ci/constraints.txt
	@command -v $(PYTHON) >/dev/null || { \
	    echo "mjxgrad needs Python 3.11 or later, and $(PYTHON) was not found. Install it, or name yours: make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; v = sys.version_info; v >= (3, 11) or sys.exit(f"mjxgrad needs Python 3.11 or later, $(PYTHON) is {v[0]}.{v[1]}. Name a later one: make PYTHON=python3.12")'
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "$(PYTHON) lacks its venv module. Install it (Debian, Ubuntu: apt-get install python3-venv) and run make again." >&2; exit 1; }
	@printf 'Installing into .venv, a minute or two the first time '
	@$(PYTHON) -m venv --clear .venv
	@$(BIN)/python -m pip install --disable-pip-version-check --progress-bar off \
	    --constraint .ci/constraints.txt --editable '.[dev]' \
	    | while read -r line; do case "$$line" in Collecting*|Installing*|Preparing*|Building*) printf .;; esac; done
	@echo ' done.'
	@touch $@

demo: ball_wall  ## set all up, run the main job, write runs/ball_wall/report.html

# A compilation takes and gives back memory all the time: kept by the process it costs 4 % less.
test: export MALLOC_TRIM_THRESHOLD_ ?= 1000000000
test: export MALLOC_TOP_PAD_ ?= 67108864
test: export MALLOC_MMAP_THRESHOLD_ ?= 33554432
test: .venv/.installed  ## set all up and run the tests
	@$(BIN)/python -m pytest -n 2 --dist worksteal $(PYTEST_ARGS)

test-slow: .venv/.installed  ## the tests that take minutes
	@$(BIN)/python -m pytest -m slow $(PYTEST_ARGS)

MUJOCO ?= >=4.0.1
mujoco4: .venv/.installed  ## run C's engine, check and sweep beside a later MuJoCo, whose maths MJX lacks
	@test -d .cache/mujoco4 || { $(PYTHON) -m venv .cache/mujoco4 && grep -v ^mujoco .ci/constraints.txt > .cache/others.txt; }
	@.cache/mujoco4/bin/python -m pip install --quiet --disable-pip-version-check --constraint .cache/others.txt \
	    --editable '.[test]' 'mujoco$(MUJOCO)'
	@.cache/mujoco4/bin/python -m pytest -n 2 --dist worksteal tests/engines tests/checking $(PYTEST_ARGS)

test-warp: .venv/.installed  ## install NVIDIA Warp beside .venv and test the engine by it, on a processor
	@test -d .cache/warp/warp || $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --target .cache/warp 'warp-lang==1.18.*'
	@PYTHONPATH=.cache/warp $(BIN)/python -m pytest tests/engines/test_warp.py $(PYTEST_ARGS)

bench: .venv/.installed  ## measure speed and memory against mjx.step
	@$(BIN)/python -m experiments bench $(ARGS)

throughput: .venv/.installed  ## measure a sweep over softness in one program against ten, and its memory
	@$(BIN)/python -m experiments throughput $(ARGS)

engines: .venv/.installed  ## measure a gradient by C MuJoCo, by MJX and by hand
	@$(BIN)/python -m experiments engines $(ARGS)

costs: .venv/.installed  ## measure what slope, onset and smoothing cost
	@$(BIN)/python -m experiments costs $(ARGS)

rates: .venv/.installed  ## measure how often a robot can be planned for, beside a plain iLQR
	@$(BIN)/python -m experiments rates $(ARGS)

gradient_audit: .venv/.installed  ## measure along which gradients of a policy its return rises
	@$(BIN)/python -m experiments gradient-audit $(ARGS)

identify-bench: .venv/.installed  ## measure identification against mujoco.sysid, answers included
	@$(BIN)/python -m experiments identify-bench $(ARGS)

robots: .venv/.installed  ## measure motion and derivatives of the robots of ten packages (downloads 0.4 GB)
	@$(BIN)/python -m experiments.robots $(ARGS)

gallery: .venv/.installed  ## write runs/index.html, a page over all results with moving pictures
	@$(BIN)/python -m experiments gallery

docs: .venv/.docs  ## READMEs, results and docstrings as a site, runs/docs/index.html
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet -f .ci/mkdocs.yml && echo runs/docs/index.html

.venv/.docs: .venv/.installed
	@$(BIN)/python -m pip install -q --disable-pip-version-check --constraint .ci/constraints.txt --editable '.[docs]'
	@touch $@

lint: .venv/.installed  ## ruff and pyright
	@$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/pyright --pythonpath $(BIN)/python

clean:  ## remove .venv, caches and runs
	@rm -rf .venv .cache .pytest_cache .ruff_cache build dist runs *.egg-info
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(EXPERIMENTS): .venv/.installed
	@$(BIN)/python -m experiments run experiments/$@.toml $(ARGS)
