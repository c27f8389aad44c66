# make study   the default study, in its own environment (ARGS="experiment=planar_trap seed=1" for others), with a C compiler
#              from the extra `native` where the machine has none
# make ladder   seven solvers on the public layouts (ten minutes on one core)
# make quality   how often gco reaches the goal on the public layouts, and how well (ARGS="--solvers gco gco_max" for more
#                solvers, "--fresh 256" for drawn layouts); make oracle: seek the best known costs (an hour or more)
# make general   48 families of constrained problems, compared with IPOPT and FATROP (ARGS="--solvers gco al_ilqr" for others)
# make worlds   woods, mazes, crossing spheres and the outside benchmarks, with pages in benchmarks/results (half an hour)
# make maps   drawn worlds as occupancy grids, and missions in worlds that are seen on the way: benchmarks/results/maps.md (under
#             forty minutes on two cores)
# make floors   drawn floor plans, gco against a grid path that is pursued (ARGS="--maps DIR": real maps, too): some minutes
# make benchmark   speed, compared with the peers (twenty minutes; ARGS="families targets" for some sections);
#                  benchmark-gpu: kernels' bits and speed on a GPU (ten minutes), then the same there
# make docs    the API reference from the docstrings, in docs/api; site: the manual with it and a search, as a site in build/site;
#              dist: sdist and wheel, in dist (docs/releasing.md); make figures: those of docs/algorithm.md and studies.md;
#              make paper: the paper's figures, tables and missions by our solvers, in benchmarks/results/paper.md
# make test    the tests; test-all: also the tests that kill processes or fly whole studies; test-slurm: those that start a
#              SLURM on this machine (as root; needs Debian's slurm-wlm and munge); robustness: those of wrong input, kills and
#              random examples, with tables of what was tried; versions: the tests of the wheel with the oldest and the newest
#              dependencies, in environments of their own (ARGS=oldest for one line); lint, types: the static checks; clean:
#              remove environments, caches and builds

PYTHON ?= python3
VENV ?= .venv
ARGS ?=

BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt
# A stamp is older than its prerequisites only where there is something to install.
RUNTIME := $(VENV)/.runtime
DEV := $(VENV)/.dev
PEERS := $(VENV)/.peers
# A separate environment, without torchgco: the wheel of acados contains a CasADi that would shadow the real one.
ACADOS := .venv-acados

# After an installation: without a C compiler a solve takes some hundred times as long, and the extra `native` brings one.
# TORCHGCO_CC says which compiler is used, or "none".
COMPILER = [ -n "$$TORCHGCO_CC" ] || $(BIN)/python -c "$(FIND)" || { \
    echo "No C compiler found: installing the extra native, which brings one."; $(INSTALL) -e '.[native]'; } || \
    echo "It can't be installed here: solves run in PyTorch, many times slower. Any of gcc, clang or zig will do."
FIND := import sys; from torchgco.native.compiler import find_compiler; sys.exit(find_compiler() is None)

# Tests start Python some hundred times, and each would compile the sources again, and every worker all tests.
unexport PYTHONDONTWRITEBYTECODE

SPEED := $(BIN)/python -m benchmarks.speed

.PHONY: floors study test test-all test-slurm robustness versions lint types clean quality oracle general worlds maps maps-known maps-seen \
    benchmark benchmark-gpu ladder docs site dist figures paper

study: $(RUNTIME)
	$(BIN)/torchgco $(ARGS)

test: $(DEV)
	$(BIN)/python -m pytest -n auto --dist worksteal $(ARGS)

test-all: $(DEV)
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slurm" $(ARGS)

test-slurm: $(DEV)
	$(BIN)/python -m pytest -m slurm $(ARGS)

robustness: $(DEV)
	$(BIN)/python -m benchmarks.endurance.robustness --write -n auto $(ARGS)

versions:
	$(PYTHON) .ci/versions $(ARGS)

ladder: $(RUNTIME)
	$(BIN)/python -m benchmarks.families.quality --write \
	    --solvers gco_fast gco gco_max multistart gco_paper al_ilqr mppi $(ARGS)

quality: $(RUNTIME)
	$(BIN)/python -m benchmarks.families.quality --write $(ARGS)

oracle: $(RUNTIME)
	$(BIN)/python -m benchmarks.families.oracle $(ARGS)

general: $(PEERS)
	$(BIN)/python -m benchmarks.families.general_peers
	$(BIN)/python -m benchmarks.families.general --write --restart 3 $(ARGS)
	$(BIN)/python -m benchmarks.families.general_exact --write

maps: $(RUNTIME)
	$(MAKE) -j2 maps-known maps-seen

maps-known: $(RUNTIME)
	$(BIN)/python -m benchmarks.families.maps --write
	$(BIN)/python -m benchmarks.outside.barn_lidar --write

maps-seen: $(RUNTIME)
	$(BIN)/python -m benchmarks.families.unknown --write

floors: $(RUNTIME)
	$(BIN)/python -m benchmarks.families.floors --write $(ARGS)

worlds: $(PEERS)
	$(BIN)/python -m benchmarks.families.worlds --write $(ARGS)
	$(BIN)/python -m benchmarks.outside.barn --write
	$(BIN)/python -m benchmarks.outside.maze --write --fatrop 8
	$(BIN)/python -m benchmarks.outside.jaxipm --write

benchmark: $(PEERS)
	$(MAKE) $(ACADOS)/.ready || echo "acados can't be installed here: the tables will say so."
	$(SPEED) $(ARGS)

benchmark-gpu: $(PEERS)
	$(BIN)/python -m benchmarks.gpu --write
	$(SPEED) --device cuda $(ARGS)

docs: $(DEV)
	$(BIN)/python docs/reference.py

site: $(DEV)
	$(BIN)/python docs/manual.py $(ARGS)

dist: $(DEV)
	rm -rf dist
	$(BIN)/python -m build

figures: $(RUNTIME)
	$(BIN)/python docs/figures.py
	$(BIN)/python docs/study_figures.py

paper: $(RUNTIME)
	$(BIN)/python -m benchmarks.paper $(ARGS)

lint: $(DEV)
	$(BIN)/ruff check .

types: $(DEV)
	$(BIN)/pyright --pythonpath $(BIN)/python

clean:
	rm -rf $(VENV) $(ACADOS) build dist docs/api .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# Python is an order-only prerequisite: pip touches its folders with every install.
$(RUNTIME): pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -e .
	@$(COMPILER)
	touch $@

$(DEV): pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -e '.[dev,plants,cluster,maps]'
	@$(COMPILER)
	touch $@ $(RUNTIME)

$(PEERS): pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -e '.[dev,plants,cluster,maps,peers]'
	@$(COMPILER)
	touch $@ $(RUNTIME) $(DEV)

$(ACADOS)/.ready: constraints.txt
	$(PYTHON) -m venv --clear $(ACADOS)
	$(ACADOS)/bin/python -m pip install --disable-pip-version-check -c constraints.txt comma-deps-acados
	touch $@
