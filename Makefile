# Needs Python, pip and make, and nothing else. `make help` lists the targets.

PYTHON ?= python3
VENV ?= .venv
# Extras of the package to install with it; `EXTRAS=cuda` on a machine with an NVIDIA GPU.
EXTRAS ?=
# Passed on to `python -m mimic.train`.
ARGS ?=
# Passed on to pytest, and the number of its workers (0: none, run in one process).
PYTEST_ARGS ?=
JOBS ?= auto

comma := ,
BIN := $(VENV)/bin
# pytest rewrites the assertions of each test file, a third of the time to collect them, unless Python keeps the result.
unexport PYTHONDONTWRITEBYTECODE
# pip's output goes to a log, whose end is shown if the install fails.
PIP_LOG := $(VENV)/install.log
INSTALL = $(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e $(1) >$(PIP_LOG) 2>&1 || \
  { tail -n 40 $(PIP_LOG) >&2; echo 'error: the install failed; all of its output: $(PIP_LOG)' >&2; exit 1; }
# One stamp for each set of extras: an install is repeated only if pyproject.toml or constraints.txt changed.
STAMP := $(VENV)/.installed$(addprefix -,$(subst $(comma),-,$(EXTRAS)))
STAMP_TEST := $(STAMP)+test
PYTEST := $(BIN)/python -m pytest -n $(JOBS) --maxprocesses 4 --dist worksteal

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help install train test test-all lint static docs format clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 12
	@echo
	@echo 'variables:  PYTHON=python3.12 VENV=.venv-3.12    another interpreter, in an environment of its own'
	@echo '            EXTRAS=cuda                          install jax for NVIDIA GPUs'
	@echo '            ARGS="env=panda7dof seed=1"          other arguments of the training command'
	@echo '            PYTEST_ARGS="-k distance" JOBS=0     arguments and number of workers of pytest'

install: $(STAMP) ## install alone

train: $(STAMP) ## install if needed, then train: make train ARGS="env=panda4dof"
	@$(BIN)/python -m mimic.train $(ARGS)

# ruff and pyright run beside pytest, whose workers wait now and then; what they say comes after its report.
BESIDE_STATIC = mkdir -p build; $(MAKE) --no-print-directory static >build/static.log 2>&1 & static=$$!; \
  trap 'kill $$static' INT TERM; $(1); tests=$$?; wait $$static; lint=$$?; cat build/static.log; \
  test $$lint -eq 0 && exit $$tests; echo 'error: ruff or pyright failed, see above' >&2; exit 1

test: $(STAMP_TEST) ## install if needed, then ruff, pyright, the quick tests and quick examples
	@$(call BESIDE_STATIC,$(PYTEST) $(PYTEST_ARGS))

test-all: $(STAMP_TEST) ## the same with the slow tests
	@$(call BESIDE_STATIC,$(PYTEST) -m 'not gpu' --timeout 1800 $(PYTEST_ARGS))

lint: static ## ruff and pyright alone

static: $(STAMP_TEST)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: $(STAMP_TEST) ## the documentation site, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	@echo 'results: build/site/index.html'

format: $(STAMP_TEST) ## format the code, mend what ruff can mend
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

clean: ## remove the environment and all caches; runs stay
	@if test -f $(VENV)/pyvenv.cfg; then rm -rf $(VENV); fi
	rm -rf build dist *.egg-info .pytest_cache .ruff_cache
	find mimic tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true

$(STAMP): pyproject.toml constraints.txt | $(BIN)/python
	@echo 'Installing mimic into $(VENV); the first time takes some minutes.'
	@$(call INSTALL,'.$(if $(EXTRAS),[$(EXTRAS)])')
	@touch $@

$(STAMP_TEST): pyproject.toml constraints.txt | $(BIN)/python
	@echo 'Installing mimic and its test tools into $(VENV); the first time takes some minutes.'
	@$(call INSTALL,'.[test$(if $(EXTRAS),$(comma)$(EXTRAS))]')
	@touch $(STAMP) $@

# Some systems split ensurepip off their Python; pip itself can then set up the environment.
$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo 'error: no $(PYTHON) here; name a Python >= 3.11: make PYTHON=/path/to/python' >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo 'error: mimic needs Python >= 3.11, got '"$$($(PYTHON) --version)"'; name another: make PYTHON=python3.12' >&2; exit 1; }
	@if $(PYTHON) -c 'import venv, ensurepip' 2>/dev/null; then \
	  $(PYTHON) -m venv $(VENV); \
	elif $(PYTHON) -c 'import venv, pip' 2>/dev/null; then \
	  $(PYTHON) -m venv --without-pip $(VENV) && \
	  $(PYTHON) -m pip --python $(VENV)/bin/python install -qq --disable-pip-version-check pip; \
	else \
	  echo 'error: $(PYTHON) has neither ensurepip nor pip; install its venv package (Debian, Ubuntu: apt install python3-venv)' >&2; exit 1; \
	fi || { rm -f $(BIN)/python*; exit 1; }
