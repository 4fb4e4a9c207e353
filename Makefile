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

.PHONY: help setup setup-test build demo week test suite quick fleet-workers fuzz mutants lint ruff mypy format bench undeclared imports verdict camera checks constants closed-loop \
	soak chaos kills live long-bag doors hard-doors pull-kills wrong-sensor articulation control-tick synthesis modular planning measure limits delta real-arms outside docs wheel lock clean

help:  ## list the targets
	@sed -nE 's/^([a-z-]+):.*## (.*)/\1|\2/p' Makefile | while IFS='|' read -r name what; do \
		printf '  make %-12s %s\n' "$$name" "$$what"; done

setup:  ## create .venv with the pinned requirements
	@scripts/setup.sh

setup-test:  ## the same, with what the tests need
	@scripts/setup.sh --test

build: setup  ## build the workspace with colcon
	@scripts/build.sh

demo: build  ## calibrate from an embedded recording; ends with before/after and where the report is
	@bash examples/demo.sh

week: build  ## a week in the life of a simulated cell: measure, check, a bumped tool, repair; some minutes
	@bash examples/week.sh

# Files run side by side, each whole on one worker, so that what a file sets up once is set up once.
PARALLEL := -n auto --dist loadfile --no-loadscope-reorder

# mypy runs beside the build and the first tests: it would keep one core busy and the others idle for half a minute.
test: setup-test  ## ruff, mypy and pytest; PYTEST_ARGS="tests/structure -x" narrows
	@$(MAKE) --jobs 2 mypy suite

suite: build ruff
	@$(PY) -m pytest $(PARALLEL) $(PYTEST_ARGS)

quick: setup-test build  ## what one runs between two edits: no nodes, no real recordings, nothing slow; a minute
	@$(PY) -m ruff check .
	@$(PY) -m pytest $(PARALLEL) -m "not dds and not slow" $(PYTEST_ARGS)

mutants: setup-test build  ## faults put into a copy of the sources: do the tests see them? MUTANTS_ARGS="--only so3.log" narrows
	@$(PY) bench/mutants/run.py $(MUTANTS_ARGS)

lint: setup-test ruff mypy  ## ruff check, ruff format --check, mypy

ruff:
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .

mypy:
	@$(PY) -m mypy

format: setup-test  ## let ruff fix what it can
	@$(PY) -m ruff check --fix .
	@$(PY) -m ruff format .

bench: setup-test build  ## times beside others doing the same; BENCH_ARGS="--only calibration --most 10000" narrows
	@bench/setup.sh
	@$(PY) bench/run.py $(BENCH_ARGS)

undeclared: setup-test build  ## planted faults on three arms: are they named? BENCH_ARGS="--seeds 3 --clean-runs 30" narrows
	@$(PY) bench/undeclared/run.py $(BENCH_ARGS)

imports: setup-test build  ## exports of trackers and motion capture: is the right mapping proposed? BENCH_ARGS="--first 7 --count 1"
	@$(PY) bench/imports/run.py $(BENCH_ARGS)

verdict: setup-test build  ## faults nobody planned for, and good arms: is the verdict right? BENCH_ARGS="--only tool --jobs 2"
	@$(PY) bench/verdict/run.py $(BENCH_ARGS)

checks: setup-test build  ## is what changed named by ten stations? BENCH_ARGS="--cells 3 --setups points"
	@$(PY) bench/check/run.py $(BENCH_ARGS)

camera: setup-test build  ## arms calibrated by a camera: true errors, intervals, advice; BENCH_ARGS="--cells 10 --rendered"
	@$(PY) bench/camera/run.py $(BENCH_ARGS)

constants: setup-test build  ## does a number that decides matter? each moved by 30 %; BENCH_ARGS="--only SIGNIFICANT --every 20"
	@$(PY) bench/constants/run.py $(BENCH_ARGS)

closed-loop: setup-test build  ## 50 poses commanded through the corrector in the simulated cell: how near the tool comes
	@$(PY) bench/closed_loop.py

long-bag: setup-test build  ## an hour at 1 kHz from the bag to the report: processor, memory, messages a second
	@$(PY) bench/long_bag.py $(BENCH_ARGS)

soak: setup-test build  ## ten minutes of 1 kHz joint states and 200 Hz poses: losses, latency, memory
	@$(PY) bench/soak.py $(SOAK_ARGS)

live: setup-test build  ## what nodes cost at 1 kHz above one that discards the messages; BENCH_ARGS="--only recorder" narrows
	@$(PY) bench/live/run.py $(BENCH_ARGS)

fleet-workers: setup-test build  ## 100 recordings over Dask on one and on two workers; BENCH_ARGS="--recordings 20" narrows
	@$(PY) bench/fleet.py $(BENCH_ARGS)

kills: setup-test build  ## the recorder killed twenty times at 1 kHz: was it recording, and what was lost? BENCH_ARGS="--kills 5"
	@$(PY) bench/kills.py $(BENCH_ARGS)

chaos: setup-test build  ## all nodes while messages, clocks, callbacks and processes fail, ten minutes; BENCH_ARGS="--minutes 2"
	@$(PY) bench/chaos.py $(BENCH_ARGS)

doors: setup-test build  ## random doors and drawers opened through the nodes, and what the hand felt; BENCH_ARGS="--scenes 8"
	@$(PY) bench/pulling.py $(BENCH_ARGS)

hard-doors: setup-test build  ## closers, magnets, gaskets, notches, end stops, with both grasps; BENCH_ARGS="--one-process"
	@$(PY) bench/hard_furniture.py $(BENCH_ARGS)

pull-kills: setup-test build  ## 200 pulls in each of which a node is killed, paused, stopped or deactivated; BENCH_ARGS="--pulls 8"
	@$(PY) bench/pull_kills.py $(BENCH_ARGS)

wrong-sensor: setup-test build  ## pulls at what jams, with a force sensor that freezes, sticks or is deaf; BENCH_ARGS="--held-back"
	@$(PY) bench/wrong_sensor.py $(BENCH_ARGS)

articulation: setup-test build  ## joints told, fitted and followed: real tracks, accuracy, time of a pose; BENCH_ARGS="--cut 0.5"
	@$(PY) bench/articulation.py $(BENCH_ARGS)

control-tick: setup-test build  ## time of a control tick, and 100 000 hostile messages; BENCH_ARGS="--messages 0"
	@$(PY) bench/control_tick.py $(BENCH_ARGS)

synthesis: setup-test build  ## the published task: genetic search, search as printed, random search
	@$(PY) bench/synthesis.py $(BENCH_ARGS)

modular: setup-test build  ## calibration after re-assembly, with and without what is known of the modules
	@$(PY) bench/modular.py $(BENCH_ARGS)

real-arms: setup-test build  ## whole recordings of real arms, as in the README's table; needs ../shared/data
	@$(PY) bench/real_arms.py $(BENCH_ARGS)

outside: setup-test build  ## the outer fifth of real arms' postures and positions, frozen, by blocks; needs ../shared/data
	@$(PY) bench/outside.py $(BENCH_ARGS)

planning: setup-test build  ## planned stations against random ones, on arms of MuJoCo
	@$(PY) bench/pose_planning.py $(BENCH_ARGS)

measure: setup-test build  ## stations until an accuracy is proven, chosen and at random; BENCH_ARGS="goal --cells 6"
	@$(PY) bench/measure/run.py $(BENCH_ARGS)

limits: setup-test build  ## a pick and place within torque limits and within constant ones, played in MuJoCo
	@$(PY) bench/limits.py $(BENCH_ARGS)

delta: setup-test build  ## a Delta by simulated annealing and by least squares, side by side; BENCH_ARGS="--robots 1"
	@$(PY) bench/delta.py $(BENCH_ARGS)

fuzz: setup-test build  ## hostile and damaged input by the thousand, five minutes; FUZZ_ARGS="--only mcap --cases 30000"
	@$(PY) bench/fuzz/run.py $(FUZZ_ARGS)

docs: setup-test build  ## renew docs/reference from the code; the documentation as a site: site/index.html
	@$(PY) scripts/reference
	@$(PY) -m mkdocs --quiet build --clean
	@echo "Documentation: site/index.html"

wheel: setup  ## the distribution modcal for pip, which needs no ROS: dist/*.whl
	@scripts/wheel.sh

lock: setup  ## renew requirements*.txt from pyproject.toml; needs python3.11 and python3.12
	@$(PY) scripts/lock.py

clean:  ## remove .venv, the build and every cache
	@rm -rf $(VENV) .venv-bench ros2_ws/build ros2_ws/install ros2_ws/log demo
	@rm -rf site dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
	@find ros2_ws/src tests bench examples scripts -name __pycache__ -prune -exec rm -rf {} +
