# Two commands: `make demo` and `make test`. Both need Python >= 3.11 with venv and pip, nothing else.
# `make test-all` has the tests that are too slow, too dependent on time or on tools for `make test`;
# `make test-release` what repeats or grinds: before a release, not with every change.
# The rest is made here: .venv with the versions of constraints.txt.

.SHELLFLAGS := -euc
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
# PYTHON=/path/to/python chooses the interpreter .venv is made with.
PYTHON ?= $(firstword $(foreach python,python3 python3.13 python3.12 python3.11 python3.14,\
  $(shell $(python) -c 'import sys; print("$(python)" if sys.version_info >= (3, 11) else "")' 2>/dev/null)))
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt
# uv takes a tenth of pip's time, and does not read pip's configuration: where it fails pip installs.
install = { $(PIP) uv && $(BIN)/uv pip install --quiet --python $(BIN)/python -c constraints.txt -e '$(1)'; } \
  2>/dev/null || { echo "uv failed; installing with pip takes minutes ..."; $(PIP) -e '$(1)'; }
# ARGS=... is handed to pytest or to the benchmarks.

help:  ## show this text
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 20

demo: $(VENV)/.runtime  ## ten swings of the simulated robot in real time at two balls, and their report
	@$(BIN)/golfbench demo

# Bytecode is kept, or collecting the tests takes twice as long.
unexport PYTHONDONTWRITEBYTECODE
# Fast tests wait for processes and sockets a third of their time: three on two processors. Their files stay whole, as
# their module-wide fixtures are made once; slow tests have none, and a file of many would come last and alone.
PARALLEL := -n 3 --dist loadfile --max-worker-restart 0
SPREAD := -n 2 --dist worksteal --max-worker-restart 0

test: $(VENV)/.dev  ## lint, types, import contracts, branches of the safety code, fast tests (6 to 12 minutes)
	@$(MAKE) --no-print-directory -j3 lint fast

test-all: $(VENV)/.dev  ## slow and paced tests in parallel, then live ones alone (ARGS for pytest)
	@failed=0; $(BIN)/python -m pytest -m '((slow and not live) or paced) and not release' $(SPREAD) --durations 10 $(ARGS) || failed=$$?; \
	$(BIN)/python -m pytest -m 'live and not paced and not release' --durations 10 $(ARGS) || failed=$$?; exit $$failed

test-release: $(VENV)/.benchmark  ## before a release: repeated tests, mutation, fault matrix, manual, soak, virtual machine (hours)
	@failed=0; $(BIN)/python -m pytest -m 'release and (paced or not live)' $(SPREAD) --durations 10 || failed=$$?; \
	$(BIN)/python -m pytest -m 'release and live and not paced' --durations 10 || failed=$$?; \
	for part in mutation faults manual; do $(MAKE) --no-print-directory $$part || failed=$$?; done; \
	$(BIN)/python -m tests.benchmarks soak --minutes 60 || failed=$$?; \
	$(MAKE) --no-print-directory test-vm || failed=$$?; exit $$failed

# Compiled before, once: each worker would do it, machine code of the numerics as well as bytecode of the tests.
compile: $(VENV)/.dev
	@$(BIN)/python -m tests.vm.compile_all
	@$(BIN)/python -m pytest --collect-only --quiet >/dev/null

fast: $(VENV)/.dev coverage compile  ## the tests of `make test` alone (ARGS for pytest)
	@$(BIN)/python -m pytest -m 'not slow and not live and not release' $(PARALLEL) $(ARGS)

lint: $(VENV)/.dev  ## ruff, strict types and import contracts
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/lint-imports
	@$(BIN)/mypy

# Counted without compilation: compiled code leaves no trace of the lines it ran.
SAFETY_TESTS := tests/bench/control/test_envelope.py tests/bench/control/test_answers.py \
  tests/bench/control/test_states.py tests/bench/base/test_lifecycle.py

coverage: $(VENV)/.dev  ## every branch of envelope, answers to requests, state changes and their tables is tested
	@NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest --quiet --no-header --tb=short \
	  -n 2 --dist worksteal --cov --cov-report= $(SAFETY_TESTS)
	@$(BIN)/coverage report --fail-under=100 \
	  --include='bench/control/envelope.py,bench/control/requests.py,bench/control/states.py,bench/base/lifecycle.py'

coverage-all: $(VENV)/.dev  ## lines and branches reached by all tests together (an hour; not by processes they start)
	@failed=0; NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest --quiet --cov --cov-report= $(SAFETY_TESTS) || failed=$$?; \
	$(BIN)/python -m pytest --quiet --cov --cov-append --cov-report= $(ARGS) || failed=$$?; \
	$(BIN)/coverage report; exit $$failed

benchmark: $(VENV)/.benchmark  ## speed of the model beside MuJoCo and Pinocchio
	@$(BIN)/python -m tests.benchmarks $(ARGS)

faults: $(VENV)/.dev  ## the whole matrix of faults, signals and phases, and the hazard table made from it
	@unsafe=0; $(BIN)/golfbench faults run --output data/faults $(ARGS) || unsafe=$$?; \
	[ $$unsafe -le 1 ]; $(BIN)/golfbench faults table data/faults/matrix.json --output sim/FAULTS.md; \
	$(BIN)/golfbench faults file data/faults/matrix.json --output sim/HAZARDS.md; exit $$unsafe

mutation: $(VENV)/.dev  ## do the tests notice small mistakes in the safety code? (20 minutes)
	@$(BIN)/python -m tests.mutation $(ARGS)

test-vm: $(VENV)/.dev  ## the driver on a real CAN stack in a virtual machine (root, Debian's packages for it)
	@$(BIN)/python -m tests.vm $(ARGS)

benchmark-vm: $(VENV)/.dev  ## the same for ten minutes of the guest, also on vcan, and the whole bench: hours
	@$(BIN)/python -m tests.vm --seconds 600 --timeout 14400 $(ARGS)
	@$(BIN)/python -m tests.vm --seconds 600 --timeout 14400 --interface vcan $(ARGS)
	@$(BIN)/python -m tests.vm --parts bench --swing-faults all --timeout 14400 $(ARGS)

manual: $(VENV)/.manual  ## the manual as a site with search that needs no network: dist/manual/index.html
	@rm -rf dist/manual
	@$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going -d dist/manual.doctrees -c tests/site . dist/manual

reference: $(VENV)/.dev  ## renew the reference swings of the replay, after a meant change of the controller
	@$(BIN)/python -m tests.replay.renew

clean:  ## remove .venv and everything made by tools (not data/)
	rm -rf $(VENV) dist .coverage .coverage.* .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find bench drivers sim tests -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.python:
	@if [ -z "$(PYTHON)" ] || ! "$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then \
	  echo "golfbench needs Python 3.11 or newer; found $$($(or $(PYTHON),python3) --version 2>&1 || true)." >&2; \
	  echo "Install it, or name it: make PYTHON=/path/to/python3.11 ..." >&2; exit 1; fi
	@if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then echo "Making $(VENV) with $$("$(PYTHON)" --version) ..."; \
	  "$(PYTHON)" -m venv $(VENV) || { rm -rf $(VENV); \
	  echo "This Python has no venv or pip (on Debian and Ubuntu: apt-get install python3-venv)." >&2; exit 1; }; fi
	@$(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "$(VENV) was made with $$($(BIN)/python --version), Python 3.11 or newer is needed: make clean" >&2; exit 1; }
	@touch $@

$(VENV)/.runtime: $(VENV)/.python pyproject.toml constraints.txt
	@echo "Installing golfbench into $(VENV) ..."
	@$(call install,.)
	@touch $@

$(VENV)/.dev: $(VENV)/.python pyproject.toml constraints.txt
	@echo "Installing golfbench and its test tools into $(VENV) ..."
	@$(call install,.[dev])
	@touch $@ $(VENV)/.runtime

$(VENV)/.benchmark: $(VENV)/.dev
	@echo "Installing MuJoCo and Pinocchio into $(VENV) ..."
	@$(call install,.[benchmark])
	@touch $@

$(VENV)/.manual: $(VENV)/.runtime
	@echo "Installing Sphinx into $(VENV) ..."
	@$(call install,.[manual])
	@touch $@

.PHONY: help demo test test-all test-release compile fast lint coverage coverage-all benchmark faults mutation manual test-vm benchmark-vm reference clean
