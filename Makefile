# `make demo` runs the main job, `make test` passes the tests. Both start from a bare clone.
PYTHON ?= python3.11
VENV   ?= .venv
BIN    := $(VENV)/bin
BUNDLE ?= policies/bipegtransfer-viskill
EPISODES ?= 20
CONFORMANCE := tests/ros/test_conformance_over_ros.py
# The CPU suffices for training and tests; name another build of torch here if you have a GPU.
TORCH  ?= torch==2.13.0

.PHONY: demo test lint unit slow wheel-check bench figures hazards mutation soak numbers faults false-trips can wire joined clean

demo: $(VENV)/.runtime
	$(BIN)/viskill dry-run $(BUNDLE)
	@echo "make demo: dry-ran $(BUNDLE) on the simulated cell; the report's path stands above."

test: lint unit
	@echo "make test: lint, types, import rules, tests and coverage passed; coverage in htmlcov/index.html."

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# What needs ROS runs in environments of its own; tests/ros/install says what is in them, and installs
# Debian's packages for them, which needs root. Conformance
# runs apart: its simulated arms are on the names that the other tests use. What runs arms against the
# clock (`quiet`) has nothing beside it: two at a time would ask for more with real-time priority than
# two cores have, and Linux then lets every control loop stand still for 50 ms in one piece.
unit: $(VENV)/.dev
	VENV=$(VENV) tests/ros/install
	rm -f .coverage .coverage.*
	OMP_NUM_THREADS=1 $(BIN)/coverage run -m pytest -n 2 --dist worksteal \
	  -m "not slow and not faults and not ros1 and not ros2 and not quiet"
	OMP_NUM_THREADS=1 $(BIN)/pytest -m "quiet and not slow and not ros2" tests/integration
	OMP_NUM_THREADS=1 .venv-ros2/bin/python -m pytest -m "quiet and not slow and ros2" tests/integration
	for ros in ros1 ros2; do for part in "$(CONFORMANCE)" "tests/ros --ignore=$(CONFORMANCE)"; do \
	  OMP_NUM_THREADS=1 .venv-$$ros/bin/python -m coverage run -m pytest \
	    -m $$ros $$part || exit; done; done
	-$(BIN)/coverage combine -q  # what a killed process has begun to write is no data
	$(BIN)/coverage html -q
	$(BIN)/coverage report --fail-under=90 | tail -n 25
	$(BIN)/coverage report --include='viskill_deploy/safety/*' --fail-under=100

# Tests that take minutes, such as 100,000 random ticks of the IK.
slow: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 -m "slow and not quiet"
	@echo "make slow: the long tests passed."

# The wheel, alone in an environment of its own without torch, does the main job.
wheel-check: $(VENV)/.dev
	rm -rf build/wheel && mkdir -p build/wheel
	$(BIN)/python -m build --wheel --outdir build/wheel . >build/wheel/build.log
	$(PYTHON) -m venv build/wheel/env
	build/wheel/env/bin/pip install -q build/wheel/*.whl
	cd build/wheel && ! env/bin/python -c "import torch" 2>/dev/null
	cd build/wheel && env/bin/viskill dry-run bipegtransfer-viskill --no-video --output run \
	  --calibration calibration/loopback_example.json --require-success 1
	@echo "make wheel-check: the wheel dry-ran its bundle without torch; output in build/wheel/run."

# Speed of one control period against pink, in one run.
bench: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/tick.py

# Dry runs of one bundle, 100 episodes a row. The figures of README and docs/results.md come from the
# commands beside them, with other numbers of episodes.
figures: $(VENV)/.runtime
	for mode in closed-loop plan; do \
	  $(BIN)/viskill dry-run $(BUNDLE) --episodes 100 --distribution reference --mode $$mode \
	    --no-video --json || exit; done
	$(BIN)/viskill dry-run $(BUNDLE) --episodes 100 --distribution wide --no-video --json
	$(BIN)/viskill dry-run $(BUNDLE) --episodes 100 --ik-solver osqp --no-video --json

# Changes one thing at a time in the safety gate: does a test notice? Resumable; up to an hour.
mutation: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/mutation/run.py --seeded
	OMP_NUM_THREADS=1 $(BIN)/python tests/mutation/run.py
	@echo "make mutation: every mutant that matters is found by the tests."

# Five million random cycles of the gate against limits that share no code with it. Resumable.
soak: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/soak/run.py
	@echo "make soak: nothing went out that was neither the request nor a stop inside the limits."

# tests/golden: thresholds, bounds and traces of the gate, after one was changed on purpose.
numbers: $(VENV)/.dev
	$(BIN)/python tests/support/gate_numbers.py

# Every fault in every phase on the served loopback, against the clock; about ten minutes. Then the
# runtime is killed fifty times in mid-motion.
faults: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest -m faults tests/faults
	rm -f build/watchdog.jsonl
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/watchdog.py
	@echo "make faults: each fault met its declared reaction in real time."

# A hidden robot on the wire: measured, fitted, run, each command killed once on its way.
joined: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/joined_run.py runs/joined --kill

# A thousand nominal dry-runs with noise, jitter and losses; resumable, an hour or more of one core.
false-trips: $(VENV)/.runtime
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/no_false_trips.py

# BiPegTransfer through simulated CiA 402 drives: at least 17 of 20 and no trip is asked for, 20 of 20
# were measured (docs/can.md). Then 14 axes against the clock.
can: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/viskill dry-run $(BUNDLE) --driver can --episodes $(EPISODES) \
	  --require-success 0.85 --no-video --json
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/can_cycles.py --check
	@echo "make can: the drives did the task; no cycle was missed that the machine did not sleep through."

# BiPegTransfer in real time through the wire at 200 Hz: simulated dVRK and driver are two processes.
wire: $(VENV)/.dev
	VENV=$(VENV) tests/ros/install
	OMP_NUM_THREADS=1 $(BIN)/pytest -m "quiet and slow and not (ros1 or ros2)" tests/integration
	for ros in ros1 ros2; do OMP_NUM_THREADS=1 .venv-$$ros/bin/python -m pytest \
	  -m "quiet and slow and $$ros" tests/integration || exit; done
	OMP_NUM_THREADS=1 $(BIN)/viskill dry-run $(BUNDLE) --driver crtk --realtime --transport dds \
	  --rate 200 --episodes $(EPISODES) --require-success 0.85 --no-video --json
	OMP_NUM_THREADS=1 .venv-ros2/bin/python -m viskill_deploy.cli.main dry-run $(BUNDLE) \
	  --driver crtk --realtime --transport ros2 --rate 200 --episodes $(EPISODES) \
	  --require-success 0.85 --no-video --json
	@echo "make wire: the task was done over DDS and over ROS 2."

# docs/hazards.md: hazard, invariant, code and tests, from data and markers.
hazards: $(VENV)/.dev
	$(BIN)/python tests/support/traceability.py

clean:
	rm -rf $(VENV) .venv-ros1 .venv-ros2 build dist runs htmlcov .coverage* .mypy_cache .ruff_cache .pytest_cache

$(VENV)/bin/pip:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.runtime: $(VENV)/bin/pip pyproject.toml
	$(BIN)/pip install -q -e .
	touch $@

$(VENV)/.dev: $(VENV)/.runtime
	$(BIN)/pip install -q $(TORCH)
	$(BIN)/pip install -q -e '.[train,dev]'
	touch $@
