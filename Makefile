# `make demo` and `make test` need only Python 3.11 or newer.

PYTHON ?= $(shell python3.11 -c '' 2>/dev/null && echo python3.11 || echo python3)
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
STUDY := configs/demo.yaml
SUDO := $(if $(filter 0,$(shell id -u)),,sudo)

.PHONY: help demo test test-services lint types docs pytest services reference-image reference-ros2-image format clean

help:
	@echo "make demo    simulate, train, replay and compare, in a few minutes"
	@echo "make test    run linters, type checker, import contract and all tests that need no service"
	@echo "make docs    build the documentation as a site, build/site"
	@echo "make test-services  test with Docker, ROS, a browser, a cluster, kills and benchmarks"
	@echo "make services  install what pip cannot bring: ROS 1, Docker, Chromium, Fast DDS (Debian 12); it needs"
	@echo "               Rust 1.88 or newer (by rustup) for the ROS 2 odometry that tests run"
	@echo "make reference-image  build the image of a ROS 1 odometry that tests run"
	@echo "make reference-ros2-image  build that of a ROS 2 odometry; the first time takes five minutes"
	@echo "make format  format the code"
	@echo "make clean   remove the virtual environment, caches and runs"

demo: $(VENV)/.demo
	$(BIN)/adaptune simulate $(STUDY)
	$(BIN)/adaptune offline $(STUDY)
	$(BIN)/adaptune online $(STUDY)
	$(BIN)/adaptune compare $(STUDY)

test: PYTEST_OPTIONS = -m "not services"
test: lint types docs pytest

test-services: PYTEST_OPTIONS = -m services
test-services: pytest

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

types: $(VENV)/.installed
	$(BIN)/mypy

docs: $(VENV)/docs/.installed
	$(VENV)/docs/bin/python -m sphinx -q -W --keep-going -d build/doctrees docs build/site

pytest: $(VENV)/.installed
	$(BIN)/pytest -n auto --dist worksteal $(PYTEST_OPTIONS)

services:
	$(SUDO) apt-get update
	DEBIAN_FRONTEND=noninteractive $(SUDO) apt-get install --yes --no-install-recommends \
		ros-core python3-rospy python3-dynamic-reconfigure debootstrap chromium g++ libfastrtps-dev \
		$(if $(shell command -v dockerd),,docker.io)
	$(SUDO) docker info >/dev/null 2>&1 || $(SUDO) service docker start \
		|| $(SUDO) sh -c 'setsid dockerd >/var/log/docker.log 2>&1 </dev/null &'
	$(SUDO) sh -c 'for i in $$(seq 30); do docker info >/dev/null 2>&1 && exit; sleep 1; done; \
		echo "the Docker engine does not answer: see /var/log/docker.log" >&2; exit 1'
	@command -v cargo >/dev/null || echo "tests of ROS 2 need Rust: install it by rustup" >&2

reference-image: $(VENV)/.installed
	$(BIN)/python docker/build.py reference

reference-ros2-image: $(VENV)/.installed
	$(BIN)/python docker/build.py reference-ros2

format: $(VENV)/.installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# What the demo needs; Open3D casts the rays of simulated sensors.
$(VENV)/.demo: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "adaptune needs Python 3.11 or newer; set PYTHON, as in: make demo PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e '.[open3d]'
	touch $@

$(VENV)/.installed: $(VENV)/.demo
	$(PIP) -e '.[dev]'
	touch $@

PURELIB := -c 'import sysconfig; print(sysconfig.get_path("purelib"))'
# On top of the other environment, so that Sphinx can import adaptune.
$(VENV)/docs/.installed: $(VENV)/.installed docs/requirements.txt
	$(BIN)/python -m venv $(VENV)/docs
	$(VENV)/docs/bin/python -m pip install --quiet --disable-pip-version-check -r docs/requirements.txt
	$(BIN)/python $(PURELIB) > "$$($(VENV)/docs/bin/python $(PURELIB))/adaptune.pth"
	touch $@

clean:
	rm -rf $(VENV) build runs *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
