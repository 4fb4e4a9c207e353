# modcal. `make help` lists the targets; demo and test need nothing but this clone, Python 3.11 or 3.12, and pip.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

VENV := .venv
PY := $(VENV)/bin/python

# PYTHON=python3.11 (or a path) chooses the interpreter of .venv and rebuilds it when it was made by another.
PYTHON ?=
export PYTHON

# Where Python may not keep what it compiled, every process that a test starts would compile modcal again.
unexport PYTHONDONTWRITEBYTECODE
# Another ROS that is sourced in this shell would put its Python modules and libraries before those of .venv.
unexport PYTHONPATH PYTHONHOME LD_LIBRARY_PATH AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH \
	VIRTUAL_ENV _ROS_WHEELS_BOOTSTRAP_COMPLETE

.PHONY: help setup setup-test build packages demo week test suite quick fuzz mutants lint ruff mypy format bench league docs wheel lock clean

help:  ## list the targets
	@sed -nE 's/^([a-z-]+):.*## (.*)/\1|\2/p' Makefile | while IFS='|' read -r name what; do \
		printf '  make %-12s %s\n' "$$name" "$$what"; done

setup:  ## create .venv with the pinned requirements
	@scripts/setup.sh

setup-test:  ## the same, with what the tests need
	@scripts/setup.sh --test

build: setup  ## build the workspace with colcon: the packages, and the interfaces, which need cmake and a compiler
	@scripts/interfaces.sh --check
	@scripts/build.sh
	@scripts/interfaces.sh

packages: setup
	@scripts/build.sh

demo: packages  ## calibrate from an embedded recording; ends with before/after and where the report is
	@bash examples/demo.sh

week: packages  ## a week in the life of a simulated cell: measure, check, a bumped tool, repair; some minutes
	@bash examples/week.sh

# Files run side by side, each whole on one worker, so that what a file sets up once is set up once.
PARALLEL := -n auto --dist loadfile --no-loadscope-reorder

# mypy runs beside the build and the first tests: it would keep one core busy and the others idle for half a minute.
test: setup-test  ## ruff, mypy and pytest; PYTEST_ARGS="tests/structure -x" narrows
	@$(MAKE) --jobs 2 mypy suite

suite: build ruff
	@$(PY) -m pytest $(PARALLEL) $(PYTEST_ARGS)

quick: setup-test build  ## what one runs between two edits: no nodes, no real recordings, nothing slow; two minutes
	@$(PY) -m ruff check .
	@$(PY) -m pytest $(PARALLEL) -m "not dds and not slow" $(PYTEST_ARGS)

mutants: setup-test build  ## faults put into a copy of the sources: do the tests see them? ARGS="--only so3.log" narrows
	@$(PY) bench/mutants/run.py $(ARGS)

fuzz: setup-test build  ## hostile and damaged input by the thousand, five minutes; ARGS="--only mcap --cases 30000"
	@$(PY) bench/fuzz/run.py $(ARGS)

lint: setup-test ruff mypy  ## ruff check, ruff format --check, mypy

ruff:
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .

mypy:
	@$(PY) -m mypy

format: setup-test  ## let ruff fix what it can
	@$(PY) -m ruff check --fix .
	@$(PY) -m ruff format .

bench: $(if $(NAME),setup-test build,setup)  ## one of the benches: NAME=speed ARGS="--only kinematics"; without a NAME: their list
	@$(PY) scripts/bench.py "$(NAME)" $(ARGS)

league:  ## methods of the field on the same recordings: build/league/index.html; ARGS="--again --only modcal" runs again
	@league/setup.sh
	@.venv-league/common/bin/python -m league.run $(ARGS)

docs: setup-test build  ## renew docs/reference from the code; the documentation as a site: site/index.html
	@$(PY) scripts/reference
	@$(PY) -m mkdocs --quiet build --clean
	@echo "Documentation: site/index.html"

wheel: setup  ## the distribution modcal for pip, which needs no ROS: dist/*.whl
	@scripts/wheel.sh

lock: setup  ## renew requirements*.txt from pyproject.toml; needs python3.11 and python3.12
	@$(PY) scripts/lock.py

clean:  ## remove .venv, the build and every cache
	@rm -rf $(VENV) .venv-interfaces .venv-bench .venv-league ros2_ws/build ros2_ws/install ros2_ws/log demo
	@rm -rf site dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis
	@find ros2_ws/src tests bench examples scripts -name __pycache__ -prune -exec rm -rf {} +
