# Two commands do all the set-up: `make demo` and `make test`. Every other target is one line.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUNS := $(VENV)/.runs
STAMP := $(VENV)/.installed
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: demo test lint types tests fmt bench docs native wheel clean

demo: $(RUNS)
	$(BIN)/splatctrl demo --force -o demo_output

test: lint types tests

lint: $(STAMP)
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/python -m tools.docstrings

types: $(STAMP)
	$(BIN)/mypy

tests: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist worksteal

fmt: $(STAMP)
	$(BIN)/ruff check --fix . && $(BIN)/ruff format .

bench: $(STAMP)
	$(BIN)/python -m benchmarks

docs: $(STAMP)
	$(BIN)/python docs/generate.py

native: $(STAMP)
	$(PIP) install -q --no-build-isolation --no-deps -c constraints.txt -e .

wheel:
	$(PYTHON) -m tools.release

clean:
	rm -rf $(VENV) build demo_output

# What the commands need, and beside it what the tests need. Reinstalls when the build's inputs change.
$(RUNS): pyproject.toml constraints.txt CMakeLists.txt $(wildcard splatctrl_cli/kernels/src/*)
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) install -q -c constraints.txt scikit-build-core nanobind cmake ninja
	$(PIP) install -q --no-build-isolation -c constraints.txt -e .
	touch $(RUNS)

$(STAMP): $(RUNS)
	$(PIP) install -q -c constraints.txt torch==2.13.0
	$(PIP) install -q --no-build-isolation -c constraints.txt -e '.[dev,sim]'
	touch $(STAMP)
