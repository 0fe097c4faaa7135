# Overfly. `make` or `make help` lists the targets.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO := outputs/demo

# Two spinning OpenMP threads on a busy machine are slower than one; these make threads sleep instead.
export OMP_WAIT_POLICY := passive

.PHONY: help env run test test-slow bench lint format clean

help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'

env: $(STAMP) ## Create .venv with every pinned package

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@# torch goes first and alone: any request that sees no torch pulls gigabytes of CUDA packages
	$(BIN)/pip install --quiet -c constraints.txt torch==2.13.0
	$(BIN)/pip install --quiet -c constraints.txt hatchling editables
	$(BIN)/pip install --quiet -c constraints.txt --no-build-isolation -e '.[dev]'
	touch $@

run: env ## Train the three phases on synthetic flights, map a held-out flight, write a report with pictures
	$(BIN)/python train.py experiment=demo hydra.run.dir=$(DEMO)/training
	$(BIN)/python train.py experiment=demo stage=evaluate from_run=$(DEMO)/training hydra.run.dir=$(DEMO)/evaluation
	$(BIN)/overfly fly suburb --seed 101 --path grid --overlap 60 --side-overlap 50 --altitude 120 --out $(DEMO)/flight
	$(BIN)/overfly map $(DEMO)/flight --cameras given --out $(DEMO)/map
	$(BIN)/overfly evaluate $(DEMO)/map/cloud.laz $(DEMO)/flight/reference.laz --json $(DEMO)/map/evaluation.json
	$(BIN)/overfly map $(DEMO)/flight --cameras given --network $(DEMO)/training --out $(DEMO)/map_faithful
	@echo "Open $(DEMO)/map/report.html (the shipped network), $(DEMO)/map_faithful/report.html (the paper's, just trained) and $(DEMO)/training/curves.png"

test: lint ## Lint, check types and run the tests (slow ones excluded)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --durations 15

test-slow: env ## Run every test, also those that take minutes
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m 'slow or not slow' --durations 30

bench: env ## Measure speed, as ratios side by side in one run
	for script in loading metrics rendering sweep; do PYTHONPATH=tests:tests/networks $(BIN)/python benchmarks/$$script.py; done

lint: env ## ruff (lint, format) and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: env ## Let ruff mend what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean: ## Remove the environment and everything computed
	rm -rf $(VENV) outputs/* .pytest_cache .mypy_cache .ruff_cache
