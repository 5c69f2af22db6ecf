# Every target makes the environment first: .venv, from requirements.lock, once. TORCH_PIP and CUDA_TORCH_PIP are options
# of pip for torch, such as an index.

PYTHON ?= python3
BIN := .venv/bin
TORCH = $$(sed -nE 's/^(torch(vision)?==[^ ]*).*/\1/p' requirements.lock)
READY := .venv/.ready
SHARED := ../shared/data
OUT ?= demo-output

export PIP_DISABLE_PIP_VERSION_CHECK = 1
export PIP_ROOT_USER_ACTION = ignore

.PHONY: demo test check kernels gpu wheel lint serve docs setup

demo: $(READY)  ## the whole job through the real service; ASK=TEXT asks another question
	$(BIN)/splatlift demo --out "$(OUT)" $(if $(ASK),--ask "$(ASK)")

# Files of tests are dealt to two processes, in the order in which they lie. A process that dies is not begun anew: it
# would go on with the test that it died of.
test: $(READY)  ## everything that must hold
	@echo "lint, and beside it kernels: compiling them takes some minutes, once"
	@$(MAKE) --no-print-directory --jobs=2 --output-sync lint kernels
	@if [ -d $(SHARED) ]; then echo "real scenes: found in $(SHARED)"; \
	else echo "real scenes: no $(SHARED) here, so the tests on them are skipped"; fi
	$(BIN)/python -m pytest -rs --durations=25 --numprocesses=2 --dist=loadfile --no-loadscope-reorder \
	--max-worker-restart=0

# Fast tests: one module at a time, nothing of a server, a second process, a real scene or many kernels.
check: $(READY) lint  ## before a commit: lint, types and the fast tests, in 90 s once set up
	$(BIN)/python -m pytest -m "not slow" --numprocesses=2 --dist=loadfile --max-worker-restart=0 tests/unit

kernels: $(READY)
	$(BIN)/python -m tests.kernels

# Another torch than the lock's build brings the triton that it was made with: that one stays.
gpu:  ## all that a card is for: conformance, speed, accuracy; prints figures
	@nvidia-smi -L 2>/dev/null | grep -q GPU || { echo "make gpu: nvidia-smi lists no card here, so nothing was run" >&2; exit 2; }
	@$(MAKE) --no-print-directory setup
	@$(BIN)/python -c 'import sys, torch; sys.exit(torch.version.cuda is None)' || { echo "installing torch's CUDA build" \
	&& $(BIN)/python -m pip install --quiet --force-reinstall $(CUDA_TORCH_PIP) $(TORCH) \
	&& awk '/^[a-z]/ { kept = !/^(torch|torchvision|triton)==/ } kept' requirements.lock \
	| $(BIN)/python -m pip install --quiet --require-hashes -r /dev/stdin; }
	@$(BIN)/python -m tests.benchmarks.gpu --look
	@held=0; env -u TRITON_INTERPRET TESTS_ON=cuda $(BIN)/python -m pytest -rs tests/gpu tests/properties \
	tests/unit/solve/test_closed_form.py || held=$$?; \
	env -u TRITON_INTERPRET $(BIN)/python -m tests.benchmarks.gpu --shared $(SHARED) && exit $$held

# torch first, from where the lock's is; all else as pip chooses, as for somebody who installs the wheel.
wheel:  ## the core's wheel, installed into an empty environment and used there without any extra
	rm -rf build dist
	$(PYTHON) -m venv build/core
	build/core/bin/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	build/core/bin/python -m pip install --quiet --no-compile $(TORCH_PIP) $$(sed -nE 's/^(torch==[^ ]*).*/\1/p' requirements.lock)
	build/core/bin/python -m pip install --quiet --no-compile dist/*.whl
	build/core/bin/python -m pip check
	build/core/bin/python -I tests/core_alone.py
	@du -sh build/core | cut -f1 | sed 's/$$/ in the environment/'

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright
	$(BIN)/lint-imports
	$(BIN)/lint-imports --config service/imports.toml
	$(BIN)/python -m tests.wording

serve: $(READY)
	$(BIN)/splatlift serve

# The site's tools are no part of the lock: they have an environment of their own, and read docstrings from .venv.
docs: $(READY)  ## the docs site in build/site; a broken link or reference fails
	[ -x .venv/docs/bin/python ] || $(PYTHON) -m venv .venv/docs
	.venv/docs/bin/python -m pip install --quiet --no-compile -r docs/requirements.txt
	PYTHONPATH=.:$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))') \
	.venv/docs/bin/python -m sphinx -W --keep-going -q -b html docs build/site

setup: $(READY)

# torch and torchvision first, from one index, as each loads beside its own build of the other alone, and the lock has
# digests of PyPI's. The libraries of a CUDA build come last. Modules are compiled as they are imported.
$(READY): requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "splatlift needs Python 3.11 or later")'
	@echo "making .venv: a few minutes, once"
	[ -x $(BIN)/python ] || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --no-compile --no-deps $(TORCH_PIP) $(TORCH)
	awk '/^[a-z]/ { kept = !/^(torch|torchvision)==/ } kept' requirements.lock \
	| $(BIN)/python -m pip install --quiet --no-compile --no-deps --require-hashes -r /dev/stdin
	$(BIN)/python -m pip install --quiet --no-compile $(TORCH_PIP) $(TORCH)
	$(BIN)/python -m pip install --quiet --no-deps -e .
	@$(BIN)/python -c "import torchvision" 2>/dev/null || echo "torchvision does not load beside this torch: scripts that" \
	"import open_clip or segment-anything need both of one index (TORCH_PIP='--index-url ...'); splatlift does without"
	@echo "compiling the kernels of 3DGS: a minute, once"
	$(BIN)/python -m tests.kernels 3dgs
	touch $@
