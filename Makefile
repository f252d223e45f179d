# `make` lists the targets. Most of them first make or refresh the environment in .venv.

PYTHON ?= python3
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

BIN := .venv/bin
# Bytecode is kept, because tests start many processes that would compile the same modules again.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal
# Each stamp file is newer than the files from which its environment was made.
VENV_STAMP := .venv/.ready
NODE_STAMP := tests/node/node_modules/.ready
BUNDLERS_STAMP := tests/bundlers/node_modules/.ready

.PHONY: help environment demo test test-all test-browsers test-newest test-oldest docs player package golden bench gpu speed sets choices ablations precision kill races fuzz fuzz-browser lint style format clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z.-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo "  PYTHON=python3.12 (for example) chooses the interpreter of a new .venv"

.venv: $(VENV_STAMP) ## make or refresh the environment

# The environment is refreshed when a dependency has changed since the stamp file was written. Python compiles what is
# imported; pip would compile all 11,000 files one after another.
$(VENV_STAMP): pyproject.toml constraints.txt
	@echo "Installing hyrfpack and its tools into .venv (a minute or two when new) ..."
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --disable-pip-version-check --no-compile -e ".[dev]" -c constraints.txt \
		| { grep --line-buffered -oE '^(Collecting|Building|Installing|Successfully installed) ?[^ ]*' || true; }
	@touch $@

# Third-party programs that read our files. Without npm, or without a network outside CI, the tests that need them skip.
$(NODE_STAMP): tests/node/package.json tests/node/package-lock.json
	@if ! command -v npm >/dev/null; then echo "npm is not installed, so the tests that need node programs will skip"; \
	elif echo "Installing programs that read splats into tests/node ..." && npm ci --prefix tests/node --loglevel error; \
	then touch $@; \
	else echo "npm could not install the node programs, so the tests that need them will skip"; test -z "$${CI:-}"; fi

# Bundlers, in which tests use the package hyrf-viewer. Without npm or a network, these tests skip.
$(BUNDLERS_STAMP): tests/bundlers/package.json tests/bundlers/package-lock.json
	@if command -v npm >/dev/null && echo "Installing bundlers into tests/bundlers ..." \
		&& npm ci --prefix tests/bundlers --loglevel error; then touch $@; \
	else echo "npm could not install the bundlers, so the tests that need them will skip"; fi

environment: $(VENV_STAMP) $(NODE_STAMP) ## install the Python packages and the node packages of the tests

demo: $(VENV_STAMP) ## train, compress and render a small synthetic scene; results in demo/
	$(BIN)/hyrfpack demo -o demo --overwrite

# mypy uses one core and starts without a cache in CI, so it runs beside the tests; its report follows theirs.
test: style $(NODE_STAMP) ## check style and types, and run the tests of every change (see tests/layers.py)
	@report=$$(mktemp); $(BIN)/mypy >"$$report" 2>&1 & types=$$!; status=0; \
	trap 'kill $$types 2>/dev/null || true; rm "$$report"' EXIT; \
	$(PYTEST) -m "not acceptance or smoke" || status=$$?; \
	wait $$types || status=$$?; echo "mypy:"; cat "$$report"; exit $$status

test-all: lint $(NODE_STAMP) $(BUNDLERS_STAMP) ## check style and types, then run all tests
	$(PYTEST)

test-browsers: $(VENV_STAMP) $(NODE_STAMP) $(BUNDLERS_STAMP) ## run the web player's tests in every installed browser (5 minutes)
	HYRFPACK_BROWSERS=all $(PYTEST) tests/web

test-newest: ## run the tests with the newest dependencies, on each installed Python (6 GB and 10 minutes each)
	$(PYTHON) -m tools.safety.versions newest

test-oldest: ## run the tests with the oldest dependencies that pyproject.toml allows, on Python 3.10
	$(PYTHON) -m tools.safety.versions oldest

docs: $(VENV_STAMP) ## build the documentation site in site/; a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

player: $(VENV_STAMP) $(NODE_STAMP) ## minify the web player's scripts again after a change, and declare the types of hyrf.js
	$(BIN)/python -m tools.browser.build_player
	$(BIN)/python -m tools.browser.build_types

package: player ## build the npm package hyrf-viewer into dist/hyrf-viewer
	$(BIN)/python -m tools.browser.build_package dist/hyrf-viewer

golden: $(VENV_STAMP) ## train the golden models of the tests again, after a change that improves training (a minute)
	$(BIN)/python -m tools.safety.train_golden

bench: $(VENV_STAMP) ## time each hot operation at several sizes against its references
	$(BIN)/python -m tools.bench

gpu: $(VENV_STAMP) ## check and measure the GPU kernels on this machine's GPU; results in docs/gpu/ (at most 9 minutes)
	$(BIN)/python -m tools.gpu.check

speed: $(VENV_STAMP) ## measure time and error of every setting on a small model; plot in runs/speed.png (some minutes)
	$(BIN)/hyrfpack bench -o runs/speed.png

sets: $(VENV_STAMP) ## train every real data set for 1,000 steps and print a table (10 minutes)
	$(BIN)/python -m tools.studies.train_sets --steps 1000

choices: $(VENV_STAMP) ## run the ablations behind the defaults (30 minutes)
	$(BIN)/python -m tools.studies.design_choices

ablations: $(VENV_STAMP) ## measure what each part of the model contributes, compared with the paper (less than an hour)
	$(BIN)/python -m tools.studies.ablations

precision: $(VENV_STAMP) ## compare training in float32 with float64, in whole and in parts (an hour)
	$(BIN)/python -m tools.studies.precision

kill: $(VENV_STAMP) ## kill the commands at random moments and check their files (25 minutes)
	$(BIN)/python -m tools.safety.kill

races: $(VENV_STAMP) ## run commands at the same time and check for lost results (10 minutes)
	$(BIN)/python -m tools.safety.races

fuzz: $(VENV_STAMP) ## feed the .hyrf reader a million hostile files (10 minutes)
	$(BIN)/python -m tools.safety.fuzz

fuzz-browser: $(VENV_STAMP) ## compare the readers in Python and in JavaScript on hostile files (a minute)
	$(BIN)/python -m tools.safety.fuzz_browser

lint: style ## check style and types only
	$(BIN)/mypy

style: $(VENV_STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(VENV_STAMP) ## format the code and fix lint errors
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean: ## remove generated files, except .venv, node_modules and runs/
	rm -rf build dist demo site *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis .versions docs/gpu/logs bench.png
	find hyrfpack tests tools -name __pycache__ -type d -prune -exec rm -rf {} +
