# Two commands set everything up on a fresh machine: `make demo` and `make test`.

PYTHON ?= python3
VENV := .venv
INSTALLED := $(VENV)/.installed
READY := $(VENV)/.ready

.PHONY: demo check lint types test quick-tests test-all test-part test-side-by-side test-alone hil hil-ready explore chaos soak ci-packages bench screenshots clean

demo: $(READY)  ## the service on simulated drives, driven through a tour; options: make demo ARGS=--stay
	$(VENV)/bin/trirail demo $(ARGS)

check: lint types  ## lint, format, types and import contracts alone

lint: $(READY)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/lint-imports

types: $(READY)
	$(VENV)/bin/mypy

quick-tests test-part test-side-by-side test-alone: export PYTHONHASHSEED = 0
# Where this is set, as in many containers, every worker and every program of a test would compile all modules anew.
quick-tests test-part test-side-by-side test-alone: export PYTHONDONTWRITEBYTECODE =
test: lint  ## before each commit, five minutes: lint, format, types, import contracts, tests of every room, whole services
	$(MAKE) --no-print-directory --jobs=2 types quick-tests  # the types of the first run take a minute of one processor

quick-tests: $(READY)
	$(VENV)/bin/pytest --numprocesses auto --dist worksteal --effort 0.1 -m "core or not (slow or viewer or long or alone)"

test-all: test-side-by-side test-alone  ## the same with every test and every example

EFFORT ?= 1
test-side-by-side: check  # one more than there are processors: many of these tests wait
	$(VENV)/bin/pytest --numprocesses $$(($$(nproc) + 1)) --dist worksteal --effort $(EFFORT) -m "not alone"

test-alone: $(READY)
	$(VENV)/bin/pytest -m alone

PART ?= 1/4
test-part: $(READY)  ## a part of what make test leaves out: make test-part PART=2/4
	$(VENV)/bin/pytest --numprocesses $$(($$(nproc) + 1)) --dist worksteal --effort 0.1 --part $(PART) \
		-m "(slow or viewer or long) and not (core or alone)"
	$(VENV)/bin/pytest --part $(PART) -m alone

hil: $(READY)  ## the service on real SocketCAN, in an emulated machine; installs what that needs, as root on Debian
	$(VENV)/bin/python -m pip install --quiet --group hil
	$(VENV)/bin/python tools/hil.py --install $(ARGS)

MINUTES ?= 30
explore: $(READY)  ## generated tests with ever new examples on every core, for make explore MINUTES=…; ARGS="--only motion"
	$(VENV)/bin/python tools/explore.py $(MINUTES) $(ARGS)

chaos: $(READY)  ## every process killed, ended and frozen in every mode; half an hour; options: make chaos ARGS="--sample 10"
	$(VENV)/bin/python tools/chaos.py $(ARGS)

SECONDS ?= 600
soak: $(READY)  ## a service under a flood of junk, for make soak SECONDS=…: it must hold
	$(VENV)/bin/python tools/flood.py $(SECONDS) $(ARGS)

ci-packages:  ## the system's packages for the tests of viewers and unit; those tests are skipped without
	.ci/packages

bench: $(READY)  ## all that is measured, under ten minutes, beside the aims; one alone: tools/bench.py --help
	$(VENV)/bin/python tools/bench.py all $(ARGS)

$(INSTALLED): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "trirail needs Python 3.11 or newer: make PYTHON=python3.12 …")'
	$(PYTHON) tools/check_ruckig.py
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --upgrade "pip>=25.1"
	$(VENV)/bin/python -m pip install --quiet --editable . --group dev
	touch $@

$(READY): $(INSTALLED)
	$(VENV)/bin/python -m trirail.processes.compiling
	touch $@

hil-ready: ci-packages $(INSTALLED)  ## what make hil installs and compiles first
	$(VENV)/bin/python -m pip install --quiet --group hil
	$(VENV)/bin/python tools/hil.py --install --prepare

PICTURES := tools/pictures
screenshots: $(READY)  ## every picture of the guides anew, from what runs; needs Chromium and the Rerun viewer
	$(VENV)/bin/python tools/frames_picture.py
	$(VENV)/bin/python tools/stages_picture.py
	$(VENV)/bin/python tools/panel_picture.py
	$(VENV)/bin/trirail workspace --plot $(PICTURES)/workspace.png
	rm -f $(PICTURES)/demo.rrd
	$(VENV)/bin/trirail demo --record $(PICTURES)/demo.rrd
	$(VENV)/bin/python tools/screenshot.py $(PICTURES)/demo.rrd $(PICTURES)/demo.png
	rm $(PICTURES)/demo.rrd
	folder=$$(mktemp -d) && $(VENV)/bin/python tools/paper.py --output $$folder && cp $$folder/paper.png $(PICTURES) && rm -r $$folder
	$(VENV)/bin/python tools/picture_stamps.py

clean:  ## remove what the commands above made
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
