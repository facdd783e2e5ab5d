# Needs Python 3.11 or 3.12 and make, nothing else: `make test`, `make train`, `make lint`, `make clean`.
# Another interpreter: `make test PYTHON=python3.12`.

PYTHON ?= python3
BIN := .venv/bin
CHECK_PYTHON := import sys; sys.exit(0 if sys.version_info[:2] in ((3, 11), (3, 12)) else "$(PYTHON) is Python %d.%d; rtc_mjx needs 3.11 or 3.12 (choose with: make PYTHON=python3.12)" % sys.version_info[:2])

.PHONY: test train lint clean

# Test files run beside each other, long ones first, as many as there are workers; each needs up to 6 GB.
WORKERS ?= 2
test: lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder --durations 40 --durations-min 5

# A run that was stopped goes on where it was.
RUN := runs/intersection/rtc_c
train: .venv/.installed
	$(BIN)/python -m rtc_mjx.train --scene intersection --method rtc --run $(RUN) $(if $(wildcard $(RUN)/config.json),--resume)
	$(BIN)/python -m rtc_mjx.render --run $(RUN) --out $(RUN)/media/top.mp4 --camera top
	$(BIN)/python -m rtc_mjx.render --run $(RUN) --out $(RUN)/media/chase.mp4 --camera chase
	$(BIN)/python -m rtc_mjx.report $(RUN) --out $(RUN)/report

lint: .venv/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# A half-made environment is taken away, so that the next try starts afresh.
$(BIN)/python:
	@command -v "$(PYTHON)" >/dev/null || { echo "$(PYTHON) not found; rtc_mjx needs Python 3.11 or 3.12 (choose with: make PYTHON=/path/to/python)" >&2; exit 1; }
	@"$(PYTHON)" -c '$(CHECK_PYTHON)'
	"$(PYTHON)" -m venv .venv || { rm -rf .venv; exit 1; }

# uv installs five times as fast as pip; without it pip does the same.
.venv/.installed: pyproject.toml requirements.lock | $(BIN)/python
	{ $(BIN)/python -m pip install --quiet uv \
	  && $(BIN)/uv pip install --python $(BIN)/python --constraint requirements.lock --editable '.[dev]'; } \
	|| $(BIN)/python -m pip install --constraint requirements.lock --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv build dist .pytest_cache .ruff_cache .mypy_cache .import_linter_cache *.egg-info
	find rtc_mjx tests -name __pycache__ -type d -prune -exec rm -rf {} +
