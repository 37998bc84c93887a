# Needs python3 (3.11 to 3.13), make and git; everything else goes into .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
EXTRAS := $(shell $(PYTHON) -c "import sys; print('sim,view,ros,evo,dev,bench' if sys.version_info < (3, 12) else 'view,ros,evo,dev,bench')")
RECORD ?=

.PHONY: setup launch test test-all bench lint clean fresh

setup: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	@echo "setting up .venv with [$(EXTRAS)] (a few minutes, once)"
	@case "$(EXTRAS)" in *sim*) ;; *) echo "pybullet has wheels up to Python 3.11 only: the simulator is left out" ;; esac
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	@touch $@

launch: setup
	$(BIN)/retracer launch graph.yaml $(if $(RECORD),--record $(RECORD))

test: setup
	$(BIN)/python -m pytest -n 3 -m "not slow"

test-all: setup
	$(BIN)/python -m pytest -n 2

bench: setup
	$(BIN)/python -m benchmarks

fresh: # numba does not see that a kernel of another file has changed
	find graph operators sim tests benchmarks -name __pycache__ -prune -exec rm -r {} +

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf .venv build .mypy_cache .ruff_cache .pytest_cache
