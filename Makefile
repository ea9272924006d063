# Everything runs in .venv; the first target that needs it makes it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Replays and the hardware drivers speak on this machine only; nothing is ever fetched.
export DRAKE_ALLOW_NETWORK := meshcat:lcm
export OMP_NUM_THREADS ?= 1

.PHONY: demo test lint bench clean

demo: $(VENV)/.ready
	$(BIN)/guiderail demo

test: $(VENV)/.ready lint
	$(BIN)/python -m pytest -n 2 --dist loadgroup

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	MYPYPATH=$(VENV)/types $(BIN)/mypy -p guiderail.models -p guiderail.systems -p guiderail.diagrams -p guiderail.tools

bench: $(VENV)/.ready
	$(BIN)/guiderail bench primitive
	$(BIN)/guiderail bench simulation

# An editable install maps the folders to guiderail.*; a type checker can't follow that, so it gets the same map as links.
$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e ".[dev]"
	mkdir -p $(VENV)/types/guiderail
	for folder in models systems diagrams tools; do ln -sfn ../../../$$folder $(VENV)/types/guiderail/$$folder; done
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache
