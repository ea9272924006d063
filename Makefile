# Everything runs in .venv; the first target that needs it makes it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Replays and the hardware drivers speak on this machine only; nothing is ever fetched.
export DRAKE_ALLOW_NETWORK := meshcat:lcm
export OMP_NUM_THREADS ?= 1

.PHONY: demo test lint bench docs gallery kills fuzz mutants injections newest clean

demo: $(VENV)/.ready
	$(BIN)/guiderail demo

# Compiled once, and not by every process that a test starts.
test: export PYTHONDONTWRITEBYTECODE =
test: $(VENV)/.ready lint
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p guiderail

# Minutes each, the last one hours, and no part of `make test`: runs that are killed at random, the newest versions of
# everything, inputs made at random, and the safety code changed place by place.
kills: $(VENV)/.ready
	$(BIN)/python tests/harness/kills/kill.py --kills 40

fuzz: $(VENV)/.ready
	$(BIN)/python tests/harness/fuzz/fuzz.py

mutants: $(VENV)/.ready
	$(BIN)/python tests/harness/mutation/mutate.py --results mutants.json

# Faults on a robot's bus, in turn and then with real processes that are killed: the robot's side is judged.
injections: $(VENV)/.ready
	$(BIN)/python tests/harness/injections/inject.py --injections 500
	$(BIN)/python tests/harness/injections/processes.py

newest:
	.ci/newest python3.12
	.ci/newest python3.13

bench: $(VENV)/.ready
	$(BIN)/python -m research.benchmarks primitive
	$(BIN)/python -m research.benchmarks simulation

# The moving pictures are kept: they take minutes, as one of them learns.
gallery: $(VENV)/.ready
	$(BIN)/python docs/make_gallery.py

# Nothing is fetched: code in pages is run, the reference is made from the code, a warning and a broken link are errors.
docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html
	$(BIN)/python docs/check_links.py docs/_build/html
	@echo docs/_build/html/index.html

$(VENV)/.docs: $(VENV)/.ready
	$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e ".[docs]"
	touch $@

$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) build dist docs/_build docs/reference *.egg-info .pytest_cache .ruff_cache .mypy_cache
