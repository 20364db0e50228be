# The pipeline as file targets: a step's target is the manifest that it writes last, so `make` redoes only what changed.
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
GEOFLEET := $(BIN)/geofleet
READY := $(VENV)/.ready

P := data/processed
MAP ?= data/raw/helsinki.osm.pbf
DRIVE ?= data/raw/helsinki_derived.pos
SCENARIO ?= paper
VEHICLES ?= 50
REPLICATES ?= 1
SEED ?= 0
FLEETS ?= 10
CODE := $(shell find geofleet sql -name '*.py' -o -name '*.sql' -o -name '*.toml' -o -name '*.csv' -o -name '*.html' 2>/dev/null)

.PHONY: FORCE help setup demo test check study results fusion-table environments ingest simulate aggregate evaluate report format bench lock clean

help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

setup: $(READY) ## Make the virtual environment .venv from the lock file

# uv when it is there, else venv and pip; the same locked, hashed versions either way. Then bytecode, which uv leaves out:
# where Python may not keep any, every process would compile pandas and numba anew, some seconds each time.
UNREAD := '[/\\](tests?|plotly|selenium|networkx|mypy|mypyc|debugpy|jedi|trio|stonesoup|wcwidth)[/\\]'
$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "geofleet needs Python 3.11 or newer; name one: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 2; }
	@if command -v uv >/dev/null && uv --version >/dev/null 2>&1; then \
	  echo "setting up $(VENV) with uv"; \
	  uv venv --quiet --clear --python "$$($(PYTHON) -c 'import sys; print(sys.executable)')" $(VENV); \
	  uv pip install --quiet --python $(BIN)/python --require-hashes -r requirements.lock; \
	  uv pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation -e .; \
	else \
	  echo "setting up $(VENV) with pip (some minutes)"; \
	  $(PYTHON) -m venv --clear $(VENV); \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock; \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .; \
	fi
	@$(BIN)/python -m compileall -q -j 0 -x $(UNREAD) $$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
	@touch $@

demo: $(P)/report/_manifest.json ## Set up, run the main job on the shipped data, name what to open
	@$(GEOFLEET) demo --show --out $(P)

ingest: $(P)/signs/signs_manifest.json $(P)/lanes/lanes_manifest.json $(P)/drives/drives_manifest.json ## Maps and drives into tables
simulate: $(P)/simulation/_manifest.json ## A fleet past the signs
aggregate: $(P)/fused/fused_manifest.json ## Detections into a map
evaluate: $(P)/evaluation/_manifest.json ## The map against its reference
report: $(P)/report/_manifest.json ## The page, the figures, the QGIS project

# Stamps of the variables above: a file that changes when, and only when, its values change.
$(P)/.inputs: VALUES = $(MAP) $(DRIVE)
$(P)/.fleet: VALUES = $(SCENARIO) $(VEHICLES) $(REPLICATES) $(SEED)
$(P)/.study: VALUES = $(SCENARIO) $(FLEETS) $(SEED)
$(P)/.inputs $(P)/.fleet $(P)/.study: FORCE
	@mkdir -p $(P); echo "$(VALUES)" | cmp -s - $@ || echo "$(VALUES)" > $@

$(P)/signs/signs_manifest.json: $(P)/.inputs $(MAP) $(CODE) | $(READY)
	$(GEOFLEET) ingest signs $(MAP) --out $(P)/signs/signs.parquet

$(P)/lanes/lanes_manifest.json: $(P)/.inputs $(MAP) $(CODE) | $(READY)
	$(GEOFLEET) ingest lanes $(MAP) --out $(P)/lanes/lanes.parquet

$(P)/drives/drives_manifest.json: $(P)/.inputs $(DRIVE) $(CODE) | $(READY)
	$(GEOFLEET) ingest drive $(DRIVE) --out $(P)/drives/drives.parquet

$(P)/simulation/_manifest.json: $(P)/.fleet $(P)/signs/signs_manifest.json $(P)/drives/drives_manifest.json
	$(GEOFLEET) simulate --signs $(P)/signs/signs.parquet --drive $(P)/drives/drives.parquet \
	  --scenario $(SCENARIO) --vehicles $(VEHICLES) --replicates $(REPLICATES) --seed $(SEED) --out $(P)/simulation

$(P)/fused/fused_manifest.json: $(P)/simulation/_manifest.json
	$(GEOFLEET) aggregate --detections $(P)/simulation/detections --scenario $(SCENARIO) --out $(P)/fused/fused.parquet

$(P)/evaluation/_manifest.json: $(P)/fused/fused_manifest.json
	$(GEOFLEET) evaluate --map $(P)/fused/fused.parquet --reference $(P)/simulation/reference.parquet \
	  --drive $(P)/drives/drives.parquet --scenario $(SCENARIO) --out $(P)/evaluation

$(P)/report/_manifest.json: $(P)/evaluation/_manifest.json $(P)/lanes/lanes_manifest.json
	$(GEOFLEET) report $(P)

STUDY := $(P)/study
STUDY_INPUTS := $(P)/signs/signs_manifest.json $(P)/drives/drives_manifest.json
STUDY_OPTIONS = --signs $(P)/signs/signs.parquet --drive $(P)/drives/drives.parquet --out $(STUDY) \
  --scenario $(SCENARIO) --replicates $(FLEETS) --seed $(SEED)

study: $(STUDY)/compare/_manifest.json $(STUDY)/fleet-size/_manifest.json $(STUDY)/sweep-semantic_rate/_manifest.json ## The paper's Table 2 and Figures 3 to 5
	@echo "Figures and tables are in $(STUDY); make results writes docs/results.md from them."

$(STUDY)/compare/_manifest.json: $(P)/.study $(STUDY_INPUTS)
	$(GEOFLEET) study compare $(STUDY_OPTIONS)

$(STUDY)/fleet-size/_manifest.json: $(STUDY)/compare/_manifest.json
	$(GEOFLEET) study fleet-size $(STUDY_OPTIONS)

$(STUDY)/sweep-semantic_rate/_manifest.json: $(STUDY)/fleet-size/_manifest.json
	$(GEOFLEET) study compare $(STUDY_OPTIONS) --methods dbscan,hdbscan,kmeans,kmedoids --sweep semantic_rate=0.9,0.95,0.98,0.99,1

environments: | $(READY) ## Urban, highway, rural and mixed fleets (the maps are in ../shared/data)
	$(BIN)/python scripts/study_environments.py --out $(STUDY)

FUSION := $(P)/fusion-study
fusion-table: | $(READY) ## Joint fusion beside DBSCAN by fleet size, on both drives, into docs/fusion-results.md
	$(GEOFLEET) study compare --methods dbscan,dbscan-corrected,joint --vehicles 1,2,3,5,8,10,15,20,30,50 \
	  --scenario paper-ideal,paper,paper-50m --tracker kalman --in-view --replicates 10 \
	  --drive data/raw/helsinki_derived.pos --drive data/raw/helsinki_derived_b.pos --out $(FUSION)
	$(BIN)/python benchmarks/joint.py table --study $(FUSION)
	$(BIN)/python benchmarks/joint_report.py

results: study ## Write docs/results.md from what the studies found
	$(BIN)/python scripts/write_results.py $(STUDY)

test: $(READY) ## Set up and pass every test
	$(BIN)/pytest -q -n 2 --dist loadfile

check: $(READY) ## Every gate: format, lint, types, import direction, SQL contracts
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/pytest -q tests/sql

bench: $(READY) ## The aggregate step beside scikit-learn, dbscan, PostGIS and DuckDB (some minutes)
	$(BIN)/python benchmarks/aggregate.py

format: $(READY) ## Format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

lock: ## Resolve the lock file anew (needs uv)
	uv pip compile --quiet --universal --python-version 3.11 --group dev --generate-hashes --no-emit-index-url \
	  --custom-compile-command 'make lock' pyproject.toml -o requirements.lock

clean: ## Remove what the steps made
	rm -rf $(P)/*/
