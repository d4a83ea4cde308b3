# Everything is set up by the targets themselves: Python 3.11 or newer with pip and venv is all that has to be there.

VENV := .venv
BIN := $(VENV)/bin
INTERPRETERS := python3 python3.13 python3.12 python3.11

# Prefect: no usage statistics and no look-up of newer releases.
export PREFECT_SERVER_ANALYTICS_ENABLED := false
export DO_NOT_TRACK := 1
export MPLBACKEND := Agg
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_NO_INPUT := 1
# Python keeps what it has compiled, even where the shell forbids it: the tests start dozens of processes.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test slow check lint types contracts house docs docs-check pytest nightly test-library fuzz bench viewer format venv install install-dev constraints clean

help:  ## Show the targets.
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 14

demo: $(VENV)/.installed  ## Simulate a small survey, process it, compare with its truth (into demo/).
	@$(MAKE) --no-print-directory --silent viewer || echo "the page to look at is not built; all else of the demo is made" >&2
	$(BIN)/roadscan demo --out demo

# Types take one processor for as long as a tenth of the tests: the tests begin beside them, when the other checks are through.
test: $(VENV)/.installed-dev  ## What every change passes: check, and the tests that are not slow.
	@$(MAKE) --no-print-directory --jobs 2 check pytest

check: lint types contracts house docs-check  ## Lint, types, import contracts, documentation.

lint: $(VENV)/.installed-dev  ## Style and formatting.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed-dev  ## Static types.
	$(BIN)/mypy
	$(BIN)/mypy --explicit-package-bases docs

contracts: $(VENV)/.installed-dev  ## Import contracts: layers, and who may import what.
	$(BIN)/lint-imports --no-logo

house: $(VENV)/.installed-dev  ## Size and shape of the library, against limits that only fall (tests/house/limits.toml).
	$(BIN)/python -m tests.house

docs: $(VENV)/.installed-dev  ## Write the generated pages of docs/.
	$(BIN)/python docs/generate.py

docs-check: $(VENV)/.installed-dev  ## Fail where a generated page is out of date.
	$(BIN)/python docs/generate.py --check

# The last lines of the output are pytest's summary.
pytest: $(VENV)/.installed-dev  ## Tests only; PYTEST_ARGS="tests/core -n0" narrows them.
	$(BIN)/python -m pytest $(or $(PYTEST_ARGS),-q -n 2 --dist worksteal -m "not slow and not nightly" --durations=10)

slow: $(VENV)/.installed-dev  ## The slow tests, most of them whole surveys from log to product: CI runs them after `make test`.
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -m "slow and not nightly" $(PYTEST_ARGS)

nightly: $(VENV)/.installed-dev viewer/dist/index.html  ## What takes too long for every change: fuzz, power cuts, servers, a second user, benchmarks, no AVX-512.
	$(BIN)/python -m pytest -q -n 2 -m nightly --timeout=1800 $(PYTEST_ARGS)

test-library: export ROADSCAN_CODECS := library
test-library: pytest slow  ## Tests with libraries in place of the own codecs.

fuzz: $(VENV)/.installed-dev  ## Every reader on 10,000 damaged files (an hour or two); FUZZ_ARGS="--format sbet" narrows it.
	$(BIN)/python -m tests.fuzz --mutants 10000 $(FUZZ_ARGS)

bench: $(VENV)/.installed-dev  ## Benchmarks.
	$(BIN)/python -m benchmarks

viewer: viewer/dist/index.html  ## Build the page of `roadscan view` and `publish` (needs Node 20 or newer with npm).

viewer/dist/index.html: viewer/node_modules/.installed viewer/build.mjs viewer/tsconfig.json $(shell find viewer/src viewer/licences -type f)
	cd viewer && npm run --silent check && npm run --silent build

viewer/node_modules/.installed: viewer/package.json viewer/package-lock.json
	@command -v npm >/dev/null || { echo "npm was not found; on Debian or Ubuntu: apt-get install nodejs npm" >&2; exit 1; }
	cd viewer && npm ci --no-audit --no-fund
	@touch $@

format: $(VENV)/.installed-dev  ## Format the code and mend what the linter can mend.
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

install: $(VENV)/.installed  ## Install roadscan into .venv.

install-dev: $(VENV)/.installed-dev  ## Install roadscan with the tools for development into .venv.

venv: $(VENV)/.created

$(VENV)/.created:
	@for python in $(INTERPRETERS); do \
	  if $$python -c 'import ensurepip, sys, venv; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null; then \
	    echo "creating $(VENV) with $$($$python --version)"; \
	    rm -rf $(VENV) && $$python -m venv $(VENV) && touch $@ && exit 0; \
	  fi; \
	done; \
	echo "No Python 3.11, 3.12 or 3.13 with venv was found (looked for: $(INTERPRETERS))." >&2; \
	echo "On Debian or Ubuntu: apt-get install python3 python3-venv" >&2; exit 1

# Between the arguments of a call, a comma of their own has to be named.
comma := ,

# uv is faster where it is present and finds the packages; pip is always there.
install_into_venv = { command -v uv >/dev/null && uv pip install --quiet --compile-bytecode --python $(BIN)/python --constraint constraints.txt --editable '$(1)'; } \
	|| $(BIN)/python -m pip install --quiet --prefer-binary --constraint constraints.txt --editable '$(1)'

$(VENV)/.installed: $(VENV)/.created pyproject.toml constraints.txt
	@echo "installing roadscan (one to two minutes the first time)"
	@$(call install_into_venv,.[frames$(comma)icp$(comma)opencv$(comma)pictures$(comma)ros])
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.created pyproject.toml constraints.txt
	@echo "installing roadscan and its tools (one to two minutes the first time)"
	@$(call install_into_venv,.[dev])
	@touch $@ $(VENV)/.installed

constraints: $(VENV)/.created  ## Write constraints.txt anew from the newest versions that pyproject.toml allows.
	rm -rf build/constraints && $(BIN)/python -m venv build/constraints
	build/constraints/bin/python -m pip install --quiet --prefer-binary '.[dev]'
	sed -n '/^#/p' constraints.txt > build/constraints.txt
	build/constraints/bin/python -m pip freeze --exclude roadscan >> build/constraints.txt
	mv build/constraints.txt constraints.txt && rm -rf build/constraints

clean:  ## Remove everything that was made here.
	rm -rf $(VENV) build dist demo viewer/dist viewer/node_modules .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
