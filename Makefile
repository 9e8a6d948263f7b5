# Everything a person or a CI job does with a checkout. Needs Python 3.11 to 3.13 and a package
# index. `make help` lists the targets.

PYTHON ?= python3
PRODUCT ?= build/sample/demo.toml
STORE ?= build/releases

VENV := .venv
BIN := $(VENV)/bin
MAGTILES := $(BIN)/magtiles
READY := $(VENV)/.ready
LOCKED := $(VENV)/.locked
LOCK := requirements/dev.lock
UV := uv==0.13.9

PIP := pip --disable-pip-version-check --no-input --quiet
FOLDERS := schemas catalog stages pipeline
LINKS := $(FOLDERS:%=build/ns/magtiles/%)
PATH_OF := $(BIN)/python -c 'import json, sys; print(json.load(sys.stdin)["path"])'
RELEASES := $(PRODUCT:%=release/%)

# Matplotlib wants a folder to write to even where there is no home.
export MPLCONFIGDIR := $(CURDIR)/build/matplotlib

.DEFAULT_GOAL := tiles
.DELETE_ON_ERROR:
.PHONY: tiles $(RELEASES) test check validate report data bench wheel-check lock clean help

tiles: $(RELEASES) ## Build and validate PRODUCT="a.toml b.toml" (default: the demo), `-j` for side by side
	@printf '%s\n' '' 'Releases are in $(STORE). Next, with RELEASE one of them:' \
	  '  $(MAGTILES) info RELEASE' \
	  '  $(MAGTILES) plot RELEASE' \
	  '  $(MAGTILES) query RELEASE --lat LAT --lon LON --height METRES' \
	  'README.md shows how a filter loads one and how to build your own survey.'

# Each product is built, then validated, by itself, so that `make -j` may run several at once; what
# is said of one comes in one piece.
$(RELEASES): release/%: % $(READY)
	@echo '$(MAGTILES) build $* --store $(STORE), and validate'
	@built=$$($(MAGTILES) build $* --store $(STORE) --json) && \
	  release=$$(printf '%s' "$$built" | $(PATH_OF)) && \
	  { checks=$$($(MAGTILES) validate "$$release"); status=$$?; \
	  printf '%s\n' "$$release" "$$checks"; exit $$status; }

build/sample/demo.toml build/sample/world.toml: pipeline/sample.py pipeline/sample_model.py \
  pipeline/synthetic_observatories.py pipeline/sample_drives.py pipeline/sample_vehicles.py $(READY)
	$(MAGTILES) sample $(@D)

test: $(READY) ## Run the tests
	@# Small maps: waking threads for them would cost more than they save.
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/pytest --numprocesses=logical --maxprocesses=8 \
	  --dist=loadfile --no-loadscope-reorder

check: $(READY) $(LINKS) ## Check formatting, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

validate: $(READY) ## Validate every release under STORE
	@found=; for manifest in $(STORE)/*/*/manifest.json; do \
	  [ -e "$$manifest" ] || continue; found=1; \
	  $(MAGTILES) validate "$${manifest%/manifest.json}" || exit; \
	done; \
	[ -n "$$found" ] || { echo 'no release under $(STORE): run make tiles' >&2; exit 1; }

report: $(READY) ## Write one offline HTML page about every release under STORE, to build/reports
	@found=; for manifest in $(STORE)/*/*/manifest.json; do \
	  [ -e "$$manifest" ] || continue; found=1; folder=$${manifest%/manifest.json}; \
	  page=build/reports/$$(basename $${folder%/*})-$$(basename $$folder).html; \
	  mkdir -p build/reports; $(MAGTILES) report "$$folder" --out "$$page" || exit; \
	done; \
	[ -n "$$found" ] || { echo 'no release under $(STORE): run make tiles' >&2; exit 1; }

data: $(READY) ## Fetch the public sources that a program can fetch, to MAGTILES_CACHE or the user's cache
	@$(MAGTILES) sources --json | $(BIN)/python -c 'import json, sys; \
	  print(*(s["id"] for s in json.load(sys.stdin) if s["by_program"]))' | \
	  xargs -n 1 $(MAGTILES) fetch

bench: $(READY) ## Run the benchmarks, each against its reference in one process
	@for script in tests/benchmarks/*.py; do \
	  echo "== $$script"; $(BIN)/python "$$script" || exit; \
	done

wheel-check: $(READY) ## Build the wheel, compare it with the tree, use it in two fresh environments
	$(BIN)/python tests/wheel/contents.py build/wheel
	$(BIN)/python tests/wheel/smoke.py build/wheel

lock: ## Resolve the dependencies anew (the only target that needs uv, which it fetches)
	$(PYTHON) -m venv build/lock
	build/lock/bin/python -m $(PIP) install '$(UV)'
	build/lock/bin/uv pip compile --quiet --upgrade --system-certs pyproject.toml \
	  --extra pipeline --group dev --universal --fork-strategy fewest --python-version 3.11 --generate-hashes \
	  --no-header --no-emit-index-url --no-emit-find-links --output-file $(LOCK)

clean: ## Remove all that make made but .venv
	@[ ! -d build ] || chmod -R u+w build
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find $(FOLDERS) tests -name __pycache__ -prune -exec rm -rf {} +

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  %-12s %s\n", $$1, $$2}' $(firstword $(MAKEFILE_LIST))

# A changed lock remakes the environment; a changed pyproject.toml only reinstalls the project.
$(LOCKED): $(LOCK)
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || { \
	  echo "magtiles needs Python 3.11, 3.12 or 3.13, and $(PYTHON) is none of them:" \
	    "name one, as in make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m $(PIP) install --no-compile --require-hashes --requirement $(LOCK)
	@touch $@

# Nothing is built in isolation: the build backend is in the lock too.
$(READY): $(LOCKED) pyproject.toml
	$(BIN)/python -m $(PIP) install --no-deps --no-build-isolation --editable .
	@touch $@

$(LINKS): build/ns/magtiles/%:
	@mkdir -p $(@D) && ln -sfn ../../../$* $@
