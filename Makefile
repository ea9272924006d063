# Everything runs in .venv; the first target that needs it creates it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUTSIDE := .venv-outside
ALONE := .venv-alone
# Distributions of this repository, installed together: the core and its siblings require each other.
SIBLINGS := hardware parts studies data lerobot mujoco cpp calibration
EDITABLE := $(SIBLINGS:%=-e packages/%)
# Meshcat and LCM use this machine's network only. Without package_map, Drake's Parser(plant) refuses its remote package
# drake_models, whose files it would download: `make TARGET DRAKE_ALLOW_NETWORK=meshcat:lcm:package_map` permits it.
export DRAKE_ALLOW_NETWORK := meshcat:lcm
export OMP_NUM_THREADS ?= 1

.PHONY: help demo test tests lint docs build bench gallery results pretrained kills fuzz mutants forces injections scaling adversary fci lerobot motions outside siblings newest clean
.DEFAULT_GOAL := help

help:  ## print this help
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /  make \1\t/' | expand -t 20

demo: $(VENV)/.ready  ## install into .venv, then train sKGRL in the narrow passage in under a minute
	$(BIN)/guiderail demo

test: $(VENV)/.ready  ## lint and all tests, at the same time: mypy uses one core for a minute
	$(MAKE) --no-print-directory -j 2 lint tests

# Bytecode is cached, because the tests start many processes.
tests: export PYTHONDONTWRITEBYTECODE =
tests: $(VENV)/.ready  ## all tests, without lint
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

lint: $(VENV)/.ready  ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p guiderail $(SIBLINGS:%=-p guiderail_%)

# Nothing is downloaded. Code in pages is run, the reference is generated, and warnings and broken links are errors.
docs: $(VENV)/.docs  ## build the documentation into docs/_build/html
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html
	$(BIN)/python docs/check_links.py docs/_build/html
	@echo docs/_build/html/index.html

build: $(VENV)/.ready  ## build sdist and wheel into dist/
	$(BIN)/python -m pip install -qq --disable-pip-version-check build
	$(BIN)/python -m build

bench: $(VENV)/.ready  ## benchmarks of the primitive and the simulation
	$(BIN)/python -m research.benchmarks primitive
	$(BIN)/python -m research.benchmarks simulation

gallery: $(VENV)/.ready  ## render the animations of docs/gallery.md, minutes
	$(BIN)/python docs/make_gallery.py

results: $(VENV)/.ready  ## write the pages of results and the table of the README
	$(BIN)/python -m research.results

pretrained: $(VENV)/.ready  ## train and evaluate the policies that come with the package, an hour or two
	$(BIN)/python -m research.pretrained

kills: $(VENV)/.ready  ## kill training runs at random instants, minutes
	$(BIN)/python tests/harness/kills/kill.py --kills 40

fuzz: $(VENV)/.ready  ## random files and arguments, minutes
	$(BIN)/python tests/harness/fuzz/fuzz.py

mutants: $(VENV)/.ready  ## mutation testing of the safety code, hours
	$(BIN)/python tests/harness/mutation/mutate.py --results mutants.json

forces: $(VENV)/.ready  ## adversarial actions against the force limit, an hour
	$(BIN)/python tests/harness/force_adversary.py --steps 100000

injections: $(VENV)/.ready  ## faults on a robot's bus, minutes
	$(BIN)/python tests/harness/injections/inject.py --injections 500
	$(BIN)/python tests/harness/injections/campaign.py --instants 25 --pairs 200
	$(BIN)/python tests/harness/injections/processes.py
	$(BIN)/python tests/harness/injections/ros2_campaign.py --instants 25 --pairs 200

scaling: $(VENV)/.ready  ## constraints in every scale against an adversary, minutes
	$(BIN)/python tests/harness/constraint_scaling.py

adversary: $(VENV)/.ready  ## obstacles, limits of motion and of joints against an adversary, an hour
	$(BIN)/python tests/harness/motion_adversary.py
	$(BIN)/python tests/harness/joint_adversary.py

fci:  ## run a Franka on the simulator of its protocol, minutes
	$(PYTHON) -m venv .venv-fci
	.venv-fci/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e ".[learn]" -e "packages/hardware[fci]" -e packages/mujoco franky-sim
	.venv-fci/bin/python tests/harness/fci/simulated_franka.py
	.venv-fci/bin/python tests/harness/fci/forces.py --steps 600

lerobot: $(VENV)/.ready  ## the plug-in for LeRobot, in an environment of its own, minutes (downloads 4 GB)
	python3.12 -m venv .venv-lerobot
	.venv-lerobot/bin/python -m pip install -qq --disable-pip-version-check -e . -e packages/lerobot \
	  "lerobot[core-scripts]" pytest
	GUIDERAIL_PYTHON=$(CURDIR)/$(BIN)/python .venv-lerobot/bin/python -m pytest -q -c /dev/null --confcutdir packages/lerobot/tests/plugin \
	  packages/lerobot/tests/plugin

motions: $(VENV)/.ready  ## adversarial commands against the limits of motion, minutes
	$(BIN)/python tests/harness/motion_limits.py

outside: $(OUTSIDE)/.ready  ## train in metaworld and robosuite with guidance, in an environment of its own, hours (downloads 3 GB)
	$(OUTSIDE)/bin/python -m pytest -q -c /dev/null --noconftest tests/research/outside_envs
	learn="$(OUTSIDE)/bin/python -m research.outside_envs.learn"; \
	for method in kgrl residual clipped_residual tqc rlpd; do \
	  $$learn peg --method $$method --seeds $$(seq 50 59) --out runs/outside; \
	  $$learn assembly --method $$method --seeds $$(seq 20 24) --out runs/outside; \
	  [ $$method = rlpd ] || $$learn nut --method $$method --seeds $$(seq 20 24) --out runs/outside; done; \
	for task in peg assembly nut; do $$learn $$task --method baselines --out runs/outside; done
	$(OUTSIDE)/bin/python -m research.outside_envs.learn table --out runs/outside

siblings:  ## each sibling's tests with the core and that sibling alone, in an environment of its own, minutes
	$(PYTHON) -m venv --clear $(ALONE)
	$(ALONE)/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e ".[learn,onnx]" \
	  pytest pytest-xdist hypothesis psutil mpmath colorednoise rosbags ruckig ur-rtde
	for sibling in $(SIBLINGS); do \
	  required=""; [ $$sibling = calibration ] && required="-e packages/studies"; \
	  $(ALONE)/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt $$required -e packages/$$sibling && \
	  $(ALONE)/bin/python -m pytest -q -n 2 --dist loadfile packages/$$sibling/tests || exit 1; \
	  $(ALONE)/bin/python -m pip uninstall -qq -y guiderail-$$sibling || exit 1; \
	done

newest:  ## the tests with the newest dependencies on Python 3.12 and 3.13
	.ci/newest python3.12
	.ci/newest python3.13

clean:  ## remove the environment and everything built
	rm -rf $(VENV) $(OUTSIDE) $(ALONE) .venv-fci .venv-lerobot build dist docs/_build docs/reference *.egg-info .pytest_cache .ruff_cache .mypy_cache

$(VENV)/.docs: $(VENV)/.ready
	$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e ".[docs]"
	touch $@

# metaworld and robosuite need an older MuJoCo than the extra `mujoco`. Neither Drake nor that extra is installed here.
# robosuite is installed without its requirements: one, a whole-body inverse kinematics, needs NumPy 1 and is not used here.
$(OUTSIDE)/.ready: pyproject.toml research/outside_envs/requirements.txt
	$(PYTHON) -m venv $(OUTSIDE)
	$(OUTSIDE)/bin/python -m pip install -qq --disable-pip-version-check -r research/outside_envs/requirements.txt -e .
	$(OUTSIDE)/bin/python -m pip install -qq --disable-pip-version-check --no-deps robosuite==1.5.2
	touch $@

# Bytecode is compiled separately: pip uses one core and compiles the tests of packages, too.
$(VENV)/.ready: pyproject.toml setup.py constraints.txt $(SIBLINGS:%=packages/%/pyproject.toml)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile -c constraints.txt -e ".[dev]" $(EDITABLE)
	$(BIN)/python -m compileall -qq -j 0 -x '/tests?/' $(VENV)/lib || true  # some packages contain templates that are not Python
	touch $@
