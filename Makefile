# make demo  sets up, characterises the gel that ships with the project and runs a simulated campaign;  make test  sets up and passes the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: setup demo test lint benchmark clean
.DELETE_ON_ERROR:

setup: $(READY)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "imr_torch needs Python 3.11 or newer, found " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	PIP_CONSTRAINT=constraints.txt $(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[dev,arviz,cluster,nuts,xlsx]"
	$(BIN)/python -m imr_torch.simulate.compiled
	touch $(READY)

demo: setup
	rm -rf demo
	$(BIN)/imr-torch characterize tutorials/data/example_gel.csv --models nhkv,gen_qkv --out demo/characterize
	$(BIN)/imr-torch campaign --case stiff-pa --designs 2 --out demo/campaign

test: setup
	$(BIN)/python -m pytest

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

benchmark: setup
	$(BIN)/python benchmarks/solver.py

clean:
	rm -rf $(VENV) demo
