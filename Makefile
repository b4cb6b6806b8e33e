# The front door. `make` lists what there is; .venv is made on first use.

.DEFAULT_GOAL := help
SHELL := /bin/bash

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.installed

TERRAIN ?= gap
EXP ?=
ARGS ?=

# a resumed run keeps its terrain, unless another one is asked for by name: that is an error
TERRAIN_OPTION = $(if $(and $(findstring --resume,$(ARGS)),$(filter file,$(origin TERRAIN))),,--terrain $(TERRAIN))

.PHONY: help $(shell sed -n "s/^\([a-z0-9-]*\):.*\#\# .*/\1/p" Makefile)

help:
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-11s %s\n", $$1, $$2 }' Makefile

setup: $(READY)  ## make .venv and install everything, with CUDA where a GPU answers

train: $(READY)  ## train a policy: TERRAIN=gap EXP=full ARGS="--num-envs 4096"
	$(BIN)/python -m cref_jax.train $(TERRAIN_OPTION) $(if $(EXP),--experiment $(EXP)) $(ARGS)

eval: $(READY)  ## measure success rates: ARGS="--run runs/NAME --suite table"
	$(BIN)/python -m cref_jax.eval $(ARGS)

play: $(READY)  ## watch a policy: ARGS="--run runs/NAME"
	$(BIN)/python -m cref_jax.play $(ARGS)

report: $(READY)  ## gather a run into one page: ARGS="--run runs/NAME"
	$(BIN)/python -m cref_jax.report $(ARGS)

reproduce: $(READY)  ## train variants x seeds, and put their tables beside the paper's: ARGS="--plan"
	$(BIN)/python -m cref_jax.reproduce $(ARGS)

export: $(READY)  ## write a policy for the robot: ARGS="--run runs/NAME --out policy"
	$(BIN)/python -m cref_jax.export $(ARGS)

sim2sim: $(READY)  ## walk the whole robot in MuJoCo C: ARGS="--policy policy --kind gap --size 0.3"
	$(BIN)/python -m cref_jax.sim2sim $(ARGS)

bench: $(READY)  ## measure steps a second on this machine
	$(BIN)/python -m cref_jax.bench $(ARGS)

gpu-program: $(READY)  ## compile the training program for a GPU, without one: ARGS="--gpu h100"
	$(BIN)/python -m cref_jax.gpu_program $(ARGS)

params: $(READY)  ## count the parameters of each variant of the network
	$(BIN)/python -m cref_jax.params $(ARGS)

doctor: $(READY)  ## check this machine, and say what to do
	$(BIN)/python -m cref_jax.doctor $(ARGS)

test: $(READY)  ## run every test: ARGS="-k depth"
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder $(ARGS)

test-fast: $(READY)  ## run the tests that take seconds
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder -m "not slow" $(ARGS)

check: $(READY)  ## format, lint and types, without changing a file
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

format: $(READY)  ## format and mend what the linter can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:  ## remove .venv and caches; runs/ stays
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The first Python from 3.11 to 3.14; PYTHON=/path/to/python overrides the search.
# CUDA 13 needs driver 580 or newer.
$(READY): pyproject.toml $(wildcard constraints/*.txt)
	@set -eu; python=""; \
	for candidate in $(or $(PYTHON),python3.12 python3.13 python3.11 python3); do \
	  if $$candidate -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' \
	    2>/dev/null; then python=$$candidate; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	  echo "error: no $(or $(PYTHON),Python) of 3.11 to 3.14 with venv; say PYTHON=/path/to/python" >&2; \
	  exit 2; \
	fi; \
	[ -x $(BIN)/python ] || $$python -m venv $(VENV); \
	extras=dev; \
	driver=$$(nvidia-smi --query-gpu=driver_version --format=csv,noheader 2>/dev/null | head -1 | cut -d. -f1) \
	  || driver=""; \
	if [[ "$$driver" =~ ^[0-9]+$$ ]]; then \
	  if (( driver >= 580 )); then extras=$$extras,warp,cuda13; else extras=$$extras,warp,cuda12; fi; \
	fi; \
	tested=constraints/py$$($(BIN)/python -c 'import sys; print("%d%d" % sys.version_info[:2])').txt; \
	echo "installing cref-jax[$$extras] into $(VENV) (a few minutes the first time)"; \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[$$extras]" \
	  $$([ -f "$$tested" ] && echo "--constraint $$tested"); \
	touch $@
