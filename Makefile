# Two commands for a newcomer: make demo, make test. Both set up what they need in .venv.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: help setup demo test lint bench config requirements clean

help:
	@echo 'make demo    simulate, calibrate, measure a turning gear through ROS 2, compare with truth'
	@echo 'make test    every test'
	@echo 'make lint    style and types'
	@echo 'make bench   speed, every figure beside its limit'
	@echo 'make config  write config/*.yaml anew from the parameter tables'
	@echo 'make setup   only set up .venv'
	@echo 'make clean   remove .venv and everything that was built'

setup:
	@$(PYTHON) requirements/install.py

demo: setup
	@$(BIN)/mems6dof demo

test: setup
	@$(BIN)/python -m pytest $(ARGS)

lint: setup
	@$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy

bench: setup
	@$(BIN)/mems6dof bench $(ARGS)

config: setup
	@$(BIN)/python -m mems6dof_ros.nodes.parameters config

requirements:
	@cd requirements && uv pip compile --quiet --universal --python-version 3.10 --no-annotate --no-header runtime.in -o runtime.txt
	@cd requirements && uv pip compile --quiet --universal --python-version 3.10 --no-annotate --no-header -c runtime.txt ros.in -o ros.txt
	@cd requirements && uv pip compile --quiet --universal --python-version 3.10 --no-annotate --no-header -c runtime.txt -c ros.txt dev.in -o dev.txt

clean:
	rm -rf .venv build install log demo_output *.egg-info .pytest_cache .ruff_cache .mypy_cache
