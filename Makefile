# make demo           sets up, characterises the example gel and runs a simulated campaign; results in imr_torch_demo/
# make test           sets up and passes the tests
# make docs           sets up and builds the documentation; open docs/_build/html/index.html
# make locks          is constraints.txt a complete lock for every supported Python and system? Installs nothing
# make release-check  builds the packages, installs them elsewhere and tries them
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# modules are compiled when they are first imported: most never are
PIP := PIP_CONSTRAINT=constraints.txt PIP_NO_COMPILE=1 $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: setup demo test lint docs locks benchmark release-check release-tools clean
.DELETE_ON_ERROR:

setup: $(READY)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "imr_torch needs Python 3.11 or newer, found " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e ".[dev,app,arviz,cluster,nuts,xlsx]"
	$(BIN)/python -m imr_torch.simulate.compiled
	touch $(READY)

demo: setup
	$(BIN)/imr-torch demo --again

test: setup
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

docs: setup
	$(PIP) -e ".[docs]"
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

benchmark: setup
	$(BIN)/python -m benchmarks.solver

locks: release-tools
	$(BIN)/python -m tools.locks

release-check: release-tools
	$(BIN)/python -m tools.release

release-tools: $(VENV)/.release

$(VENV)/.release: $(READY)
	$(PIP) -e ".[release]"
	touch $(VENV)/.release

clean:
	rm -rf $(VENV) docs/_build
