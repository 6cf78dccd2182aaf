# Every target prepares what it needs; `make help` lists them.
SHELL := bash
.SHELLFLAGS := -eo pipefail -c
.DEFAULT_GOAL := help

BAG ?= bags/SH1_1
PROTOCOL ?=
PYTHON ?= python3
JOBS ?= 2

# Runs what follows in the built package's environment.
IN_ENV := source env.sh;

.PHONY: help bootstrap demo test check format bench bench-peers reproduce accuracy cameras calibration docs lock clean

help:  ## This list
	@sed -nE 's/^([a-z-]+):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 14

bootstrap:  ## Build the package; afterwards: source env.sh
	@scripts/bootstrap.sh

demo: bootstrap  ## Flatten a recorded garment: a table, and figures in build/demo (BAG=bags/TR1_1)
	@$(IN_ENV) vflatten replay $(BAG) $(if $(PROTOCOL),--protocol $(PROTOCOL)) \
	  --json build/demo/result.json --figures build/demo
	@echo "figures in build/demo: $$(cd build/demo; echo *.png)"

test: bootstrap  ## All tests, on the built package (TESTS="test/core -k plane" for some; JOBS=1: one at a time)
	@$(IN_ENV) VFLATTEN_REQUIRE_ROS=1 pytest --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder $(TESTS)

check: bootstrap  ## Lint and types
	@$(IN_ENV) ruff check
	@$(IN_ENV) ruff format --check
	@$(IN_ENV) env -u PYTHONPATH mypy

format: bootstrap  ## Rewrite the code the way `make check` wants it
	@$(IN_ENV) ruff check --fix --exit-zero; ruff format

bench: bootstrap  ## Time our stages over sizes (ARGS="--save a.json", "--compare a.json b.json", --docs)
	@$(IN_ENV) python benchmarks/bench.py $(ARGS)

bench-peers: build/peers/ready  ## Beside other libraries: docs/benchmarks.md (QUICK=1: under a minute)
	@PYTHONPATH=. build/peers/bin/python benchmarks/bench_peers.py $(if $(QUICK),--quick) $(ARGS)

reproduce: bootstrap  ## The paper's experiments: docs/reproduction.md
	@$(IN_ENV) python benchmarks/reproduce.py $(ARGS)

accuracy: bootstrap  ## Errors over recordings with known sizes: docs/accuracy.md (RECORDINGS="NAME=DIR ...")
	@$(IN_ENV) python benchmarks/accuracy.py $(RECORDINGS) $(ARGS)

cameras: bootstrap  ## The same with other errors of depth, and an item that swings: docs/cameras.md
	@$(IN_ENV) python benchmarks/cameras.py $(RECORDINGS) $(ARGS)

calibration: bootstrap  ## How well a rotation of cloth tells the axis: the table of docs/calibration.md
	@$(IN_ENV) python benchmarks/calibration.py $(RECORDINGS) $(ARGS)

docs: bootstrap  ## Regenerate docs/parameters.md from the defaults in the code
	@$(IN_ENV) python -m vflatten_ros.parameters > build/parameters.md; mv build/parameters.md docs/

# Keeps the pins that still fit; UPGRADE=1 moves to the newest versions.
COMPILE := ../build/uv/bin/uv pip compile --quiet --universal --generate-hashes --python-version 3.10 \
  --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" $(if $(UPGRADE),--upgrade)
DEBIANS := $(addprefix --no-emit-package ,numpy pytest iniconfig packaging pluggy pygments)
lock:  ## Pin all requirements anew, transitive ones and hashes included
	@$(PYTHON) -m venv build/uv
	@build/uv/bin/pip install --quiet --disable-pip-version-check uv==0.13.9
	@cd requirements; $(COMPILE) runtime.in dev.in ros.in --output-file wheels.txt
	@cd requirements; $(COMPILE) beside-ros.in --constraint wheels.txt $(DEBIANS) --output-file beside-ros.txt
	@cd requirements; $(COMPILE) peers.in --constraint wheels.txt --output-file peers.txt

clean:  ## Remove everything that was built
	@rm -rf .venv build install log env.sh *.egg-info .mypy_cache .ruff_cache .pytest_cache

# The peers are compared without ROS, in an environment of their own.
build/peers/ready: requirements/peers.txt
	@rm -rf build/peers
	@$(PYTHON) -m venv build/peers
	@build/peers/bin/pip install --quiet --disable-pip-version-check --require-hashes --no-deps -r $<
	@touch $@
