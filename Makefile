# Two commands on a fresh Debian or Ubuntu machine with Python 3.11 or newer:
#   make demo   the main job, end to end      make test   lint, types and tests
# Both make the virtual environment first. VENV=path uses another one.
VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin
SEED ?= 7

.PHONY: setup demo test test-long lint format coverage mutation wheel-test bench faults clean docs

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: $(PYTHON) is older than 3.11; pass PYTHON=python3.11 or newer" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV) || \
	  { echo "error: no venv module; apt-get install python3-venv, then again" >&2; exit 2; }
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet torch==2.13.0
	$(BIN)/pip install --quiet -e '.[all]'
	touch $@

demo: setup
	$(BIN)/groundstation demo --seed $(SEED)

# WORKERS processes: one flies in real time, the others compute (tests/conftest.py). With three on two cores flights that
# wait for a busy companion fail now and then.
WORKERS ?= 2
PYTEST := $(BIN)/pytest -n $(WORKERS)

test: setup lint
	$(PYTEST)

# Studies, which take minutes each; CI runs them after `make test`.
test-long: setup
	$(PYTEST) -m long

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# What ruff can mend by itself: the order of imports, line breaks.
format: setup
	$(BIN)/ruff check --fix-only --quiet .
	$(BIN)/ruff format .

# sdist and wheel, and the wheel in a new environment beside foreign folders of our names.
wheel-test: setup
	$(BIN)/python tests/packaging/install.py

# Every branch of the control law, by tests in one process; below 100 % it fails.
LAW := $(addprefix tests/companion/test_,watch.py guard.py succession.py control.py controllers.py inference.py model_files.py)

coverage: setup
	mkdir -p build
	$(BIN)/pytest $(LAW) --cov --cov-report=term

# What the tests of guard, watch and the reasons to stop would let pass: docs/mutation.md
mutation: setup
	nice -n 10 $(BIN)/mutmut run --max-children 2
	$(BIN)/mutmut results

bench: setup
	for b in benchmarks/*.py; do echo "== $$b"; $(BIN)/python $$b || exit 1; done

# make faults QUICK=1 is a tenth of it; SCALE=0.3 and FAULTS="--only silences,kills" choose more finely.
SCALE ?= $(if $(QUICK),0.1,1)

faults: setup
	$(BIN)/python tests/faults/campaign.py --scale $(SCALE) $(FAULTS)

# The documentation site into build/site; a link that leads nowhere is an error.
docs: setup
	$(BIN)/pip install --quiet -e '.[docs]'
	$(BIN)/sphinx-build --fail-on-warning --keep-going -q -b html docs build/site

clean:
	rm -rf $(VENV) out build mutants *.egg-info
