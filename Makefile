# `make demo` and `make test` on a fresh clone are enough: both make .venv first, the demo only what the commands need.
# One that has pip if there is one: Debian keeps it apart (tools/make_venv.py brings it then).
PYTHON := $(firstword $(shell for needs in venv,ensurepip venv; do for p in python3.11 python3.12 python3.13; do \
	$$p -c "import $$needs" 2>/dev/null && echo $$p; done; done; true))
BIN := .venv/bin
STAMP := .venv/.installed
BASE := .venv/.installed-base
OUT := out/demo
SAMPLE := recordings/samples/box_toss
export PIP_DISABLE_PIP_VERSION_CHECK := 1
EXTRAS := dev,sim,learned,rig-realsense,rig-franka,rig-ur

.PHONY: setup demo test test-all check bench blender variety

setup: $(STAMP)

$(BASE): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "no Python 3.11, 3.12 or 3.13 found; as root, type: apt-get update && apt-get install -y python3-venv" >&2; exit 1; }
	test -x $(BIN)/pip || $(PYTHON) tools/make_venv.py .venv
	$(BIN)/python tools/check_system.py --for demo --bring .venv
	@echo "installing packages, gigabytes of them: pip says nothing meanwhile, for minutes"
	# torch first and pinned: otherwise another package pulls the newest CUDA build, several gigabytes
	$(BIN)/python -m pip install -q --no-compile torch==2.13.0 -c constraints.txt
	$(BIN)/python -m pip install -q --no-compile -e . -c constraints.txt
	# what pip would compile on one core, beside the kernels (files of newer Pythons are passed by, as pip does)
	$(BIN)/python -m compileall -qq .venv/lib acquisition calibration groundtruth processing recordings & \
	$(BIN)/python tools/compile_kernels.py; kernels=$$?; wait; exit $$kernels
	touch $@

$(STAMP): $(BASE)
	$(BIN)/python tools/check_system.py --for test --bring .venv
	@echo "installing what the tests need: pip says nothing meanwhile"
	$(BIN)/python -m pip install -q -e ".[$(EXTRAS)]" -c constraints.txt
	touch $@

demo: $(BASE)
	$(BIN)/toss-session info $(SAMPLE)
	$(BIN)/toss-process $(SAMPLE) --out $(OUT)/results
	rm -f $(OUT)/result.rrd $(OUT)/result.png  # toss-view overwrites nothing; these are this target's own
	$(BIN)/toss-view $(OUT)/results --save $(OUT)/result.rrd
	$(BIN)/toss-view $(OUT)/results --screenshot $(OUT)/result.png
	$(BIN)/python tools/judge_demo.py $(OUT)/results
	@echo "look at $(OUT)/result.png and $(OUT)/results/report.html, open $(OUT)/result.rrd: $(BIN)/toss-view $(OUT)/results"

# One process a core, a file's tests in one of them (tests/conftest.py); more threads would only wait for each other.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n logical --maxprocesses 8

test: $(STAMP)
	$(PYTEST) -m "not slow and not gpu and not rig"

test-all: $(STAMP)
	$(PYTEST) -m "not gpu and not rig"

check: $(STAMP)
	$(BIN)/python tools/check.py

bench: $(STAMP)
	for bench in $(filter-out tools/bench_variety.py,$(wildcard tools/bench_*.py)); do echo "== $$bench"; $(BIN)/python $$bench || exit 1; done

# Blender's Python package pins another numpy and is under the GPL: it lives beside .venv, only tools/variety runs it.
blender: .venv-blender/.installed

.venv-blender/.installed: tools/variety/blender.txt
	@command -v python3.11 >/dev/null || { echo "no Python 3.11 found, which bpy 4.5 needs: apt-get install -y python3.11-venv" >&2; exit 1; }
	test -x .venv-blender/bin/python || python3.11 -m venv .venv-blender
	.venv-blender/bin/python -m pip install -q -r tools/variety/blender.txt
	touch $@

# The judge table: 60 sessions made, processed by two trackers, scored, deleted. Hours; goes on where it was stopped.
variety: $(STAMP) blender
	$(BIN)/python tools/bench_variety.py --split judge --n 60 --resume
