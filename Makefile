# make demo: from a flight to tested firmware.  make test: all tests.  make lint, make bench: for developers.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# One more than processors: tests over MAVLink wait for the vehicle's clock.
JOBS ?= $(shell expr $$(nproc) + 1)

demo: $(VENV)/.installed
	$(BIN)/mimopilot demo --out demo

test: $(VENV)/.installed-test cross
	$(BIN)/pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

# What emulates and builds for the vehicle's processor, and the browser that opens reports; installed when missing.
CROSS = gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm chromium
cross:
	@test -f "$$(arm-none-eabi-g++ -print-file-name=librdimon.a 2>&1)" && command -v qemu-system-arm >/dev/null \
	&& command -v chromium >/dev/null \
	|| { test "$$(id -u)" = 0 && command -v apt-get >/dev/null && export DEBIAN_FRONTEND=noninteractive \
	&& apt-get update -qq && apt-get install -qq -y --no-install-recommends $(CROSS); } \
	|| { echo "the tests need a cross compiler, QEMU and Chromium; on Debian, as root: apt-get install $(CROSS)"; exit 1; }

# The packages under the names that they import by, for the type checker.
AS_IMPORTED := build/as-imported/mimopilot
as-imported:
	@rm -rf $(AS_IMPORTED) && mkdir -p $(AS_IMPORTED) && ln -s $(CURDIR)/mimopilot/* $(AS_IMPORTED) \
	&& ln -s $(CURDIR)/tuning $(CURDIR)/codegen $(CURDIR)/sitl $(AS_IMPORTED)

# The package on every Python that there is: built, installed outside of the tree, and used.
PYTHONS ?= python3.11 python3.12 python3.13
pythons: $(VENV)/.installed-test
	@for python in $(PYTHONS); do \
		if $$python -c "" 2>/dev/null; then $(BIN)/python -m tests.package $$python || exit 1; \
		else echo "$$python: not here"; fi; done

# The manual as a site, with the reference of commands and API.
docs: $(VENV)/.installed-test as-imported
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet

# The tutorial's pictures, by the commands that it shows.
PICTURES = timeline-1 frequency-response sensitivity predicted-motion spectra-1
pictures: $(VENV)/.installed
	@rm -rf build/pictures && mkdir -p build/pictures && cd build/pictures && export PATH=$(CURDIR)/$(BIN):$$PATH \
	&& mimopilot experiment adam0 --seed 1 --out flight.ulg && mimopilot tune flight.ulg --out my.gains.toml \
	&& mimopilot report flight.ulg --gains my.gains.toml --out flight.html --figures figures \
	&& for name in $(PICTURES); do cp figures/$$name.png $(CURDIR)/docs/images/ || exit 1; done

lint: $(VENV)/.installed-test as-imported
	$(BIN)/ruff check .
	$(BIN)/hadolint Dockerfile
	$(BIN)/mypy

bench: $(VENV)/.installed-test cross
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[bench]'
	$(BIN)/python -m tests.bench

$(BIN)/python:
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo "no virtual environment could be made; on Debian: apt-get install python3-venv"; exit 1; }

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[vehicle,report]'
	touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test,docs]'
	touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) demo build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

.PHONY: demo test lint docs pictures bench clean cross as-imported pythons
