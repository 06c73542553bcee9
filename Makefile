# GridSim. `make help` (or plain `make`) lists what there is.
#
# Each target sets up its own needs: .venv is created if there is none, and installed into
# again only when pyproject.toml has changed. Tests and checks need more than a user does.

VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
DEV    := $(VENV)/.installed-dev
# What .venv is made with: PYTHON if given, else the first of these that is 3.11 or newer and can make one.
PYTHON ?=
PYTHONS := python3 python3.11 python3.12 python3.13 /usr/bin/python3
# pip would spend most of a minute on compiling all that it installs. Python itself compiles what it imports, and keeps
# that unless PYTHONDONTWRITEBYTECODE is set.
NO_COMPILE := $(if $(PYTHONDONTWRITEBYTECODE),,--no-compile)
# Passed on to the command: make evolve ARGS="--scenario seamless --seed 3"
ARGS   ?=
PORT   ?= 5000

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help install develop evolve dqn compare test test-slow ui bench results pictures docs lint format

help: ## This list
	@echo "usage: make TARGET [ARGS=\"...\"]"; echo
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  %-9s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo; echo "  PYTHON=/path/to/python  makes .venv with that one (3.11 or newer);  PORT=5000  is make ui's"

install: $(STAMP) ## Create .venv and install into it (the others do so by themselves)

develop: $(DEV) ## The same with what tests, style and type checks need

evolve: $(STAMP) ## Evolve a driver; ARGS="--workers 2 --seed 3" are passed on, ARGS=--help lists them
	@$(BIN)/gridsim-evolve $(ARGS)

dqn: $(STAMP) ## Train a driver by deep Q-learning instead; ARGS as above
	@$(BIN)/gridsim-dqn $(ARGS)

compare: $(STAMP) ## Compare the learners on all roads, up to an hour; ARGS=--quick takes minutes
	@$(BIN)/gridsim-compare $(ARGS)

test: $(DEV) ## Run the tests, in minutes; ARGS="tests/gridsim -k rays" are passed on to pytest
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not e2e" $(ARGS)

test-slow: $(DEV) ## Run the other tests: whole commands, real Ray workers, kills, hosts, images
	$(BIN)/python -m pytest -n 2 --dist loadfile -m e2e --durations=30 $(ARGS)

ui: $(STAMP) ## Show the runs in MLflow's UI, on loopback
	@$(BIN)/python -m cluster.commands.ui $(PORT)

bench: $(STAMP) ## Measure throughput on one core, then scaling over workers
	$(BIN)/python benchmarks/throughput.py
	$(BIN)/python benchmarks/scaling.py

results: $(DEV) ## Measure the tables of docs/results.md again, in some five hours; resumable
	$(BIN)/python benchmarks/results.py --write $(ARGS)

pictures: $(STAMP) ## Draw docs/'s pictures of the five scenarios again
	$(BIN)/python docs/pictures.py

docs: $(DEV) ## Build the documentation's site, build/site/index.html, in a minute
	@rm -rf build/site
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/sphinx-build -W --keep-going -q docs build/site

lint: $(DEV) ## Check style, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(DEV) ## Rewrite the code in the project's format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The stamp comes last, so that an install cut short is done again.
$(STAMP): EXTRA := [evolve]
$(DEV): EXTRA := [dev]
$(STAMP) $(DEV): pyproject.toml
	@if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
	  for python in $(or $(PYTHON),$(PYTHONS)); do \
	    if "$$python" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then \
	      echo "creating $(VENV) with $$python (the first time takes some minutes)"; \
	      $(BIN)/python -c '' 2>/dev/null || clear=--clear; \
	      "$$python" -m venv $$clear $(VENV) || exit 1; break; \
	    fi; \
	  done; \
	  if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
	    echo "make: needs Python 3.11 or newer with its venv module (on Debian and Ubuntu: apt install python3-venv);" >&2; \
	    echo "make: name one that is not found by itself with make PYTHON=/path/to/python" >&2; exit 1; \
	  fi; \
	fi
	$(BIN)/python -m pip install --disable-pip-version-check $(NO_COMPILE) --editable ".$(EXTRA)"
	@touch $(STAMP) $@
