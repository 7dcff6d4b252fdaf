# The two commands: `make demo` runs the main job, `make test` passes the tests. Both set everything up first.
# Needed: Python 3.11 to 3.13 with venv and pip, make, git. Another interpreter: `make test PYTHON=/path/to/python3.12`
# (it matters only while there is no .venv yet).

PYTHON ?= python3
ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.mpm-env-ready

# A PYTHON that someone named is taken at its word; otherwise the first of these that will do.
CANDIDATES := $(if $(filter file default undefined,$(origin PYTHON)),$(PYTHON) python3.13 python3.12 python3.11,$(PYTHON))
RIGHT_VERSION := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
WILL_DO := import ensurepip, venv; $(RIGHT_VERSION)

.DEFAULT_GOAL := help
.PHONY: help setup demo bench guard coupling validation test test-xla test-fast lint format pins clean

help:  ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1: /p' $(MAKEFILE_LIST) | awk -F': ' '{ printf "  make %-10s %s\n", $$1, $$2 }'

setup: $(READY)  ## make .venv with the pinned packages (the other targets do it too)

demo: $(READY)  ## dig sand, write the log and pictures to demo_out/ (ARGS=... adds options)
	$(BIN)/mpm-env demo dig --out demo_out $(ARGS)

bench: $(READY)  ## all benchmarks, into docs/performance.md (ARGS=--quick; PEERS=folder, see benchmarks/README.md)
	$(BIN)/python -m benchmarks $(ARGS) $(if $(PEERS),--peers $(PEERS))

guard: $(READY)  ## has a substep become slower than the ratio kept? (ARGS=--keep keeps this run's)
	$(BIN)/python -m benchmarks.guard $(ARGS)

coupling: $(READY)  ## contact measured, into docs/coupling.md (ARGS=--quick; ARGS="drop blade" runs some parts)
	$(BIN)/python -m benchmarks.coupling $(ARGS)

validation: $(READY)  ## grains against references, into docs/validation.md (ARGS=--quick; ARGS="motion" runs some parts)
	$(BIN)/python -m benchmarks.validation $(ARGS)

test: $(READY)  ## all tests, a process per core
	$(BIN)/python -m pytest -n auto --dist loadfile $(ARGS)

test-xla: $(READY)  ## physics and coupling once more on plain XLA, without the native kernels
	MPM_ENV_KERNELS=xla $(BIN)/python -m pytest tests/physics tests/coupling -m "not slow" -n auto --dist loadfile $(ARGS)

test-fast: $(READY)  ## the tests under 5 s each
	$(BIN)/python -m pytest -m "not slow" $(ARGS)

lint: $(READY)  ## ruff (lint and format) and mypy
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy

format: $(READY)  ## let ruff repair what it can
	$(BIN)/python -m ruff check --fix-only .
	$(BIN)/python -m ruff format .

pins: $(READY)  ## resolve the newest allowed versions into constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	sed -n '/^#/p' constraints.txt > constraints.new
	$(BIN)/python -m uv pip compile pyproject.toml --all-extras --universal --python-version 3.11 \
		--no-header --no-annotate --no-emit-index-url --quiet >> constraints.new
	mv constraints.new constraints.txt

clean:  ## remove what the other targets made, .venv too
	rm -rf $(VENV) .cache .mypy_cache .pytest_cache .ruff_cache .hypothesis build dist demo_out coupling_out

# A .venv made by hand is kept and brought to the pinned versions; one that does not run is made anew. The build
# tools come first, so that they are pinned like the rest and the package builds without a second environment.
$(READY): pyproject.toml constraints.txt $(wildcard mpm_env/native/*.h mpm_env/native/*.cpp mpm_env/native/build.py)
	@if ! $(BIN)/python -c '' 2>/dev/null; then \
		for python in $(CANDIDATES); do \
			if "$$python" -c '$(WILL_DO)' 2>/dev/null; then found="$$python"; break; fi; \
		done; \
		if [ -z "$$found" ]; then \
			echo "mpm-env needs Python 3.11 to 3.13 with venv and pip, and none of these is one: $(CANDIDATES);" \
				"install one or name it: make PYTHON=/path/to/python3.12" >&2; \
			exit 1; \
		fi; \
		echo "making $(VENV) with $$("$$found" --version)"; \
		"$$found" -m venv --clear $(VENV); \
	elif ! $(BIN)/python -c '$(RIGHT_VERSION)'; then \
		echo "$(VENV) holds $$($(BIN)/python --version), and mpm-env needs Python 3.11 to 3.13:" \
			"remove $(VENV) and run make again" >&2; \
		exit 1; \
	fi
	@echo "installing the pinned packages into $(VENV) (the first time takes minutes)"
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt hatchling editables jaxlib
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt --no-build-isolation -e '.[dev]'
	@touch $@
