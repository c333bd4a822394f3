# make setup   a virtual environment in .venv with everything in it (the other targets do it first)
# make demo    parse a bundled bag through real ROS 2 nodes; results in out/demo
# make demo-learn  learn three objects from bags of views, then parse a scene with them; results in out/demo-learn
# make demo-unknown  meet an object that no library holds, learn it from two views, find it; results in out/demo-unknown
# make paper   run all that the Bayes3D paper shows, for hours; results in out/paper, pages in docs/validation;  QUICK=--quick  a short form, pages in out/paper-quick/pages
# make test    all tests, two files at a time;  make test PYTEST_ARGS="test/geometry -x"  some of them
# make lint    ruff and mypy
# make build   build the package into install/ with colcon, for ros2 run and ros2 launch
# make colcon  build the package and run its tests with colcon;  COLCON_TESTS="test/geometry"  some of them
# make clean   remove .venv and everything built; results in out/ stay
#
# PYTHON=/path/to/python3 chooses the Python; otherwise tools/find_python.sh does.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
OUT := out/demo
QUICK :=
PAPER_OUT := out/paper$(if $(QUICK),-quick)
PAPER_PAGES := $(if $(QUICK),$(PAPER_OUT)/pages,docs/validation)
PYTEST_ARGS :=
WORKERS := 2
COLCON_TESTS :=
# Set by the ROS wheels in their own processes; inherited by make, it would stop them from finding their libraries.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help setup demo demo-learn demo-unknown paper test lint build colcon clean
help:
	@sed -n 's/^# \(make\)/\1/p' Makefile

setup: $(STAMP)

# With ROS 2 sourced its own rclpy is used, through --system-site-packages; elsewhere the same Jazzy comes as wheels.
# --ignore-installed: of what pip needs none is apt's. Its matplotlib is built for numpy 1, and its colcon starts nodes
# with the system's Python.
$(STAMP): setup.py pyproject.toml setup.cfg Makefile tools/find_python.sh
	@set -e; python=$$(PYTHON="$(PYTHON)" tools/find_python.sh); \
	extras=sim,experiments,test,lint,colcon; options=; own=; \
	if "$$python" -c 'import rclpy' >/dev/null 2>&1; then \
	    options=--system-site-packages; own=--ignore-installed; echo "setup: using the ROS 2 that is sourced ($${ROS_DISTRO:-unknown})"; \
	else \
	    extras=ros,$$extras; echo "setup: no ROS 2 sourced; installing ROS 2 Jazzy's wheels from PyPI"; \
	fi; \
	echo "setup: making $(VENV) with $$python and installing [$$extras]; a few minutes the first time"; \
	"$$python" -m venv --clear $$options $(VENV); \
	touch $(VENV)/COLCON_IGNORE; \
	$(BIN)/python -m pip install -qq $$own --editable ".[$$extras]"; \
	touch $(STAMP); echo "setup: done; the command is $(BIN)/bayes3d"

demo: setup
	$(BIN)/bayes3d demo --out $(OUT)

LEARNED := mug mustard_bottle cracker_box
demo-learn: setup
	for name in $(LEARNED); do \
	    $(BIN)/bayes3d learn bags/views_$$name --name $$name --library $(OUT)-learn/library --replace || exit; \
	done
	$(BIN)/bayes3d parse bags/three_objects --library $(OUT)-learn/library --out $(OUT)-learn/parsed

demo-unknown: setup
	$(BIN)/bayes3d demo --unknown --out $(OUT)-unknown

PAPER := mug-pose object-type noise-ablation real-scenes camera-tracking
paper: setup
	for name in $(PAPER); do $(BIN)/bayes3d evaluate $$name $(QUICK) --out $(PAPER_OUT) || exit; done
	$(BIN)/bayes3d report $(PAPER_OUT) --out $(PAPER_PAGES)

# A worker that crashes ends the run: pytest-xdist 3.8 can wait forever for a worker that replaces it (its issue 784).
test: setup
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --max-worker-restart 0 $(PYTEST_ARGS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

build: setup
	. $(BIN)/activate && colcon --log-base build/colcon-log build --paths . --build-base build/colcon --install-base install

colcon: build
	. $(BIN)/activate && . install/local_setup.sh && colcon --log-base build/colcon-log test --paths . \
	    --build-base build/colcon --install-base install --event-handlers console_direct+ --return-code-on-test-failure \
	    --pytest-args $(COLCON_TESTS)

clean:
	rm -rf $(VENV) build install log *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
