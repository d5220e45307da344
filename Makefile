# SPDX-License-Identifier: Apache-2.0
# Every target sets up what it needs by itself. PYTHON chooses the interpreter (3.10 to 3.13).
PYTHON ?= python3
PYTEST_ARGS ?= -n 2 --dist worksteal
VENV := .venv
DOCS := .venv-docs
BIN := $(VENV)/bin
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

# a sourced ROS 2 is used instead of the wheels
ifdef ROS_DISTRO
  ifeq ($(shell $(PYTHON) -c 'import rclpy' 2>/dev/null && echo yes),yes)
    ROS := $(ROS_DISTRO)
  endif
endif
ROS ?= wheels
MADE := $(VENV)/.made-for-$(ROS)

# the wheels mark a process that has set itself up; another environment's Python must not see it
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
# images often set it: every process would then compile all that it imports, for 3 s
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help env kernels demo test lint types docs ci tf s3 config clean

help:  ## this list
	@sed -n 's/^\([a-z0-9]*\):.*## /  make \1\t/p' Makefile | expand -t 16

env: $(MADE)  ## make .venv, in which .venv/bin/rlml is the command
	@echo "== $(VENV) is ready"

$(MADE): setup.py $(wildcard requirements/python*.txt) requirements/ros.txt requirements/install
	@PYTHON='$(PYTHON)' requirements/install $(VENV) $(ROS)
	@touch $@

kernels: env  ## compile the kernels, where their sources changed since
	@$(BIN)/rlml warm-up

demo: kernels  ## simulator, front end and back end live over DDS, with a report in out/demo
	@$(BIN)/rlml demo

test: kernels  ## all tests
	@$(BIN)/python -m pytest $(PYTEST_ARGS)

lint: env  ## ruff: rules and format
	@$(BIN)/ruff check . && $(BIN)/ruff format --check .

types: env  ## mypy, strict
	@$(BIN)/mypy

docs: $(DOCS)/.made  ## build the documentation: site/index.html
	@NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/mkdocs build --quiet --strict && echo "site/index.html"

$(DOCS)/.made: $(wildcard requirements/docs-*.txt)
	@echo "== making $(DOCS) for the documentation"
	@lock=$$($(PYTHON) -c 'import sys; print("requirements/docs-python%d.%d.txt" % sys.version_info[:2])') && \
	  $(PYTHON) -m venv --clear $(DOCS) && \
	  $(DOCS)/bin/python -m pip --disable-pip-version-check --quiet install --no-compile -r $$lock
	@touch $@

s3: env  ## install a server of S3 for tests into .venv
	@lock=$$($(BIN)/python -c 'import sys; print("requirements/s3-python%d.%d.txt" % sys.version_info[:2])') && \
	  $(BIN)/python -m pip --disable-pip-version-check --quiet install --no-compile -r $$lock

config: env  ## write config/ from the declared parameters and topics
	@for name in default simulator deformable_slam ekf_slam reflector_detector; do \
	  $(BIN)/python -m rlml_lab.support.config_file $$name.yaml >config/.new && \
	  mv config/.new config/$$name.yaml; done
	@$(BIN)/python -m rlml_lab.support.security_policy >config/.new && \
	  mv config/.new config/security_policy.xml

tf: env  ## build tf2_msgs, which the wheels lack, into .venv
	@[ $(ROS) != wheels ] || .ci/tf2_msgs/install $(VENV)

ci:  ## all that is checked before a change is taken
	@.ci/run

clean:  ## remove what make made
	rm -rf $(VENV) $(DOCS) build install log out site
