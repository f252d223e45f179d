# `make` lists what there is. Every target makes its own environment first, in .venv.

PYTHON ?= python3
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

BIN := .venv/bin
READY := .venv/.ready
PEERS := tests/node/node_modules/.ready

.PHONY: help demo test test-browsers test-newest test-oldest docs player bench gpu speed sets choices ablations precision kill races fuzz fuzz-browser lint format clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z.-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo "  PYTHON=python3.12 and the like choose the interpreter of a new .venv"

.venv: $(READY) ## make or refresh the environment

# The stamp is younger than the files it was made from, so a changed dependency refreshes the environment.
$(READY): pyproject.toml constraints.txt
	@echo "Installing hyrfpack and its tools into .venv (a minute or two when new) ..."
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e ".[dev]" \
		| { grep --line-buffered -oE '^(Collecting|Building|Installing|Successfully installed) ?[^ ]*' || true; }
	@touch $@

# Programs of others that read our files. Where there is no npm, or off CI no network, the tests that need them skip.
$(PEERS): tests/node/package.json tests/node/package-lock.json
	@if ! command -v npm >/dev/null; then echo "npm is not here: the tests with programs under node will skip"; \
	elif echo "Installing programs that read splats into tests/node ..." && npm ci --prefix tests/node --loglevel error; \
	then touch $@; \
	else echo "npm could not install: the tests with programs under node will skip"; test -z "$${CI:-}"; fi

demo: $(READY) ## train, compress and render a small made-up scene; results in demo/
	$(BIN)/hyrfpack demo -o demo --overwrite

test: lint $(PEERS) ## check style and types, then run all tests
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal

test-browsers: $(READY) ## run the tests of the page, each in every browser that is here (five minutes)
	HYRFPACK_BROWSERS=all $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal tests/web

test-newest: ## run the tests with the newest versions, on each Python that is here (6 GB and ten minutes each)
	$(PYTHON) -m tools.safety.versions newest

test-oldest: ## run the tests with the oldest versions that pyproject.toml allows, on Python 3.10
	$(PYTHON) -m tools.safety.versions oldest

docs: $(READY) ## write the documentation as a site to site/; a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

player: $(READY) $(PEERS) ## give the scripts of the web player short names again, after they have changed
	$(BIN)/python -m tools.browser.shorten

bench: $(READY) ## time each hot operation at several sizes against its references
	$(BIN)/python -m tools.bench

gpu: $(READY) ## check and measure the GPU kernels on this machine's GPU; results in docs/gpu/ (thirteen minutes at most)
	$(BIN)/python -m tools.gpu.check

speed: $(READY) ## time beside error of every setting, on a small model; plot in runs/speed.png (two to four minutes)
	$(BIN)/hyrfpack bench -o runs/speed.png

sets: $(READY) ## train every real set for 1,000 steps and print the table (ten minutes)
	$(BIN)/python -m tools.studies.train_sets --steps 1000

choices: $(READY) ## the ablations behind the defaults (half an hour)
	$(BIN)/python -m tools.studies.design_choices

ablations: $(READY) ## what each part of the model is worth, beside the paper (under an hour)
	$(BIN)/python -m tools.studies.ablations

precision: $(READY) ## the same training in float32 and in float64, whole and in parts (an hour)
	$(BIN)/python -m tools.studies.precision

kill: $(READY) ## kill the commands at random moments and check what is left (ten minutes)
	$(BIN)/python -m tools.safety.kill

races: $(READY) ## run commands at the same time and check that no result is lost (ten minutes)
	$(BIN)/python -m tools.safety.races

fuzz: $(READY) ## feed the .hyrf reader a million hostile files (ten minutes)
	$(BIN)/python -m tools.safety.fuzz

fuzz-browser: $(READY) ## feed hostile files to the readers in Python and in JavaScript and compare (a minute)
	$(BIN)/python -m tools.safety.fuzz_browser

lint: $(READY) ## check style and types only
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY) ## rewrite the code in the house style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean: ## remove what was made here, but for .venv, node_modules and runs/
	rm -rf build dist demo site *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find hyrfpack tests tools -name __pycache__ -type d -prune -exec rm -rf {} +
