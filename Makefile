# Every target works as the first command on a fresh machine: what it needs is installed first (tools/setup.sh).
BIN := .venv/bin
READY := .venv/.ready
# For the tests, on two cores: some of them only wait.
WORKERS := 3

.PHONY: help demo test check static peers pictures fixtures clean
.DEFAULT_GOAL := help

help:
	@echo "make demo        bridge, record, verify and replay on this machine, with real ROS 2"
	@echo "make test        all tests, after the checks of 'make check': the gate for every change"
	@echo "make check       format, lint, types, pins, generated documents, terms, architecture"
	@echo "make pictures    the pictures in docs/pictures anew, from the recordings in fixtures/"
	@echo "make fixtures    the recordings in fixtures/ anew, by the commands of fixtures/README.md"
	@echo "make clean       remove what make has made, .venv too"
	@echo
	@echo "The first run installs what is missing (a few minutes); PYTHON=... chooses the interpreter."

demo: $(READY)
	@$(BIN)/igtl-gateway demo

test: static peers
	@$(BIN)/python -m pytest -q -n $(WORKERS) --dist loadfile --no-loadscope-reorder --max-worker-restart 0 --durations=10 || { \
		[ $$? -eq 1 ] || exit 1; \
		echo "Once more, alone: what failed beside others."; $(BIN)/python -m pytest -q --last-failed --last-failed-no-failures none; }

check: static
	@$(BIN)/python -m pytest -q tests/test_architecture.py

static: $(READY)
	@$(BIN)/ruff format --check --quiet --output-format concise . || { echo "To format: $(BIN)/ruff format"; exit 1; }
	@$(BIN)/ruff check --quiet --output-format concise .
	@$(BIN)/mypy --no-error-summary
	@$(BIN)/python tools/constraints.py --check
	@$(BIN)/python tools/docs.py --check
	@$(BIN)/python tools/terms.py

peers:
	@tools/setup.sh peers

pictures: $(READY)
	@tools/setup.sh pictures
	@$(BIN)/python tools/pictures.py

fixtures: $(READY)
	@$(BIN)/python -m tools.fixtures

$(READY): pyproject.toml lab/pyproject.toml constraints.txt igtl_gateway/__init__.py hatch_build.py igtl_gateway/convert/_express.c
	@tools/setup.sh venv
	@touch $@

clean:
	rm -rf .venv .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find igtl_gateway lab tests tools -name __pycache__ -type d -prune -exec rm -rf {} +
