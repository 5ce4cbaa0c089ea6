# Everything goes into .venv beside this file; delete it with `make clean`.
# Needed: GNU make and a Python of at least 3.11 with its venv module.

.DEFAULT_GOAL := help
.PHONY: help train test lint types clean

CFG ?= solo8_quick
PYTHON ?= python3.13 python3.12 python3.11 python3

# On Linux the torch of PyPI carries CUDA: gigabytes that only an NVIDIA GPU needs. Without one,
# the same version comes from PyTorch's index of CPU builds; where that cannot be reached, pip
# says so and takes what its own indexes offer. `make train TORCH_INDEX=` asks those alone; the
# index of another CUDA than PyPI's can be named the same way.
TORCH_INDEX ?= $(shell nvidia-smi >/dev/null 2>&1 || echo https://download.pytorch.org/whl/cpu)

help:  ## show these lines
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1	\2/p' Makefile

train: .venv/.installed  ## train the five skills of Solo-8 (or CFG=<another configuration>)
	.venv/bin/kiras-train --cfg $(CFG)

# Threads of torch that wait take no core from the process beside them.
test: .venv/.installed-dev  ## run the fast tests, a process a core
	OMP_WAIT_POLICY=passive .venv/bin/pytest -n auto --dist loadfile

lint: .venv/.installed-dev  ## check style and format
	.venv/bin/ruff check
	.venv/bin/ruff format --check

# Type checkers do not follow the package map of an editable install, so a plain copy is checked:
# what it calls kiras_rl/envs/x.py is envs/x.py here. MuJoCo 4.0 comes without stubs for its
# compiled modules: the one-line stubs say that a package holds more than its Python source shows.
types: .venv/.installed-dev  ## check the types
	rm -rf .venv/typed build/lib
	.venv/bin/python -m pip install -q --no-deps --target .venv/typed .
	cp pyproject.toml .venv/typed
	mkdir -p .venv/typed/typings/mujoco/studio
	echo 'def __getattr__(name: str): ...' | \
	    tee .venv/typed/typings/mujoco/__init__.pyi >.venv/typed/typings/mujoco/studio/__init__.pyi
	cd .venv/typed && ../bin/pyright --pythonpath ../bin/python kiras_rl

clean:  ## remove the environment and build outputs, never runs/
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache

# The stamps make a second call start at once; a change of either file installs again.
.venv/.installed: EXTRAS =
.venv/.installed-dev: EXTRAS = [dev,video]
.venv/.installed .venv/.installed-dev: pyproject.toml constraints.txt | .venv/bin/pip
	@echo "installing into .venv: a minute or more, the first time"
	$(if $(TORCH_INDEX),.venv/bin/python -m pip install -q --no-deps --retries 0 --timeout 10 \
	    -c constraints.txt --extra-index-url $(TORCH_INDEX) torch)
	.venv/bin/python -m pip install -q -c constraints.txt -e '.$(EXTRAS)'
	@touch .venv/.installed $@

.venv/bin/pip:
	@for python in $(PYTHON); do \
	    $$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || continue; \
	    $$python -c 'import ensurepip, venv' 2>/dev/null || { bare=$${bare:-$$python}; continue; }; \
	    exec $$python -m venv --clear .venv; \
	done; \
	if [ "$$bare" ]; then \
	    echo "error: $$bare has no venv module: install the package $$(basename $$bare)-venv" >&2; exit 1; \
	fi; \
	echo "error: none of '$(PYTHON)' is Python 3.11 or newer: install one," \
	    "or name it, as in make train PYTHON=/path/to/python3" >&2; \
	exit 1
