# Everything a fresh machine needs is Python (3.11 or newer) and make: `make demo`, `make test`.

PYTHON ?= python3
VENV := .venv
VENV_24_04 := .venv-ubuntu-24.04
DEMO := demo_output
PIP_INSTALL := -m pip install --quiet --disable-pip-version-check
REQUIREMENTS := requirements/runtime.txt requirements/ros.txt requirements/test.txt
PYTEST := -m pytest -n 2 --dist worksteal

# The first interpreter that runs: a name on the path may be a shim for a version that is not there.
PYTHON_24_04 = $(shell for p in python3.12 $$HOME/.pyenv/versions/3.12*/bin/python3.12 $(PYTHON); do \
	"$$p" -c 'import ensurepip, venv' 2>/dev/null && { echo "$$p"; break; }; done)

.DEFAULT_GOAL := help
.PHONY: help demo test test-ubuntu-24.04 lint format benchmark table5 clean distclean

help: ## Show this list.
	@grep -E '^[a-z0-9.-]+:.*##' Makefile | sed -E 's/:.*## /\t/' | expand -t 22

demo: $(VENV)/ready ## Simulate a flight, replay it, compare with the truth; results in demo_output/.
	rm -rf $(DEMO)
	$(RUN) -m thermal_stereo_vo simulate demo --output $(DEMO)/flight
	$(RUN) -m thermal_stereo_vo replay $(DEMO)/flight --output $(DEMO)/run

test: lint ## Check style and types, run all tests, print the coverage.
	$(RUN) $(PYTEST) --cov --cov-report=term:skip-covered

test-ubuntu-24.04: $(VENV_24_04)/ready ## Run all tests against the versions of Ubuntu 24.04.
	$(RUN_24_04) $(PYTEST)

lint: $(VENV)/ready ## Check style and types.
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(RUN) -m mypy

format: $(VENV)/ready ## Bring all files into the style.
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

benchmark: $(VENV)/ready ## Measure the time per stage.
	$(RUN) -m thermal_stereo_vo benchmark

table5: $(VENV)/ready ## Fly nine simulated flights by every method (hours; goes on where it stopped).
	$(RUN) -m thermal_stereo_vo benchmark table5 --output report/table5 $(TABLE5)

clean: ## Remove what was produced, except the environments.
	rm -rf $(DEMO) build install log report .coverage .*_cache .hypothesis .venv*/numba_cache
	find . -name __pycache__ -not -path './.venv*' -prune -exec rm -rf {} +

distclean: clean ## Remove the environments too.
	rm -rf $(VENV) $(VENV_24_04)

# Compiled kernels are kept in the environment they were compiled for, apart for each state of their
# sources: numba does not notice when a kernel that another file calls has changed.
KERNELS := $(shell cat $$(grep -rl --include='*.py' njit thermal_stereo_vo | sort) | sha256sum | cut -c -12)
RUN = NUMBA_CACHE_DIR=$(CURDIR)/$(VENV)/numba_cache/$(KERNELS) $(VENV)/bin/python
RUN_24_04 = NUMBA_CACHE_DIR=$(CURDIR)/$(VENV_24_04)/numba_cache/$(KERNELS) $(VENV_24_04)/bin/python

$(VENV)/ready: $(REQUIREMENTS) requirements/lint.txt
	$(call make_venv,$(PYTHON),$(VENV))
	$(VENV)/bin/python $(PIP_INSTALL) $(^:%=-r %)
	touch $@

$(VENV_24_04)/ready: $(REQUIREMENTS) requirements/ubuntu-24.04.txt
	$(call make_venv,$(PYTHON_24_04),$(VENV_24_04))
	$(VENV_24_04)/bin/python $(PIP_INSTALL) $(REQUIREMENTS:%=-r %) -c requirements/ubuntu-24.04.txt
	touch $@

define make_venv
@$(1) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	echo "thermal_stereo_vo needs Python 3.11 or newer: choose one with 'make PYTHON=python3.12 ...'" >&2; exit 1; }
@$(1) -c 'import ensurepip, venv' 2>/dev/null || { \
	echo "This Python cannot make virtual environments: install them first, on Debian and Ubuntu with 'sudo apt install python3-venv'" >&2; exit 1; }
@echo "Installing the dependencies into $(2), once ..."
@$(1) -m venv $(2)
endef
