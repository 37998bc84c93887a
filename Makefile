# Needs python3 (3.11 to 3.13), make and git; everything else goes into .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
EXTRAS := $(shell $(PYTHON) -c "import sys; print('sim,view,ros,evo,dev,bench' if sys.version_info < (3, 12) else 'view,ros,evo,dev,bench')")
KERNELS := $(shell grep -rl --include='*.py' njit operators sim)
RECORD ?=
GRAPH ?= graph.yaml

.PHONY: setup launch test test-all bench lint clean fresh

setup: .venv/kernels

.venv/installed: pyproject.toml constraints.txt
	@echo "setting up .venv with [$(EXTRAS)] (a few minutes, once)"
	@case "$(EXTRAS)" in *sim*) ;; *) echo "pybullet has wheels up to Python 3.11 only: the simulator is left out" ;; esac
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	@touch $@

# all anew where one has changed: numba does not see that a kernel of another file has
.venv/kernels: .venv/installed $(KERNELS)
	@echo "compiling the numba kernels (a minute or two, once and when one has changed)"
	-@$(BIN)/python -m graph.warming operators
	@touch $@

launch: setup
	$(BIN)/retracer launch $(GRAPH) $(if $(RECORD),--record $(RECORD))

test: setup
	$(BIN)/python -m pytest -n 3 -m "not slow"

test-all: setup
	$(BIN)/python -m pytest -n 2

bench: setup
	$(BIN)/python -m benchmarks

fresh: # whatever Python and numba have compiled; the next target that needs it compiles anew
	rm -f .venv/kernels
	find graph operators sim tests benchmarks -name __pycache__ -prune -exec rm -r {} +

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf .venv build .mypy_cache .ruff_cache .pytest_cache
