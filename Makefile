# Needs Python with venv, and make. A sourced ROS 2 is used where there is one: its rclpy then
# comes before any wheel, through a virtual environment that sees the system's packages.
# ROS 2 Jazzy's Python where there is one that starts, which a shim of pyenv need not.
PYTHON ?= $(shell for python in python3.12 "$$(pyenv prefix 3.12 2>&1)/bin/python" python3; do \
  "$$python" -c '' 2>/dev/null && echo "$$python" && break; done)
VENV ?= .venv
BIN := $(VENV)/bin
# A sourced ROS 2, not the wheels of an active virtual environment.
SYSTEM_ROS := $(shell $(PYTHON) -c 'import rclpy, sys; assert sys.prefix == sys.base_prefix' \
  2>/dev/null && echo --system-site-packages)

# Most tests keep one core busy. All tests of a file run in the same process.
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile

.PHONY: test quick mutants ablate demo demo-ros lint docs wheel release-names release-check clean

# With COVERAGE=1 it finds which tests run which line, too, and takes a quarter more time.
test: export COVERAGE_PROCESS_START = $(if $(COVERAGE),$(CURDIR)/.ci/coverage.ini)
test: export ROOT = $(CURDIR)
test: $(VENV)/installed
	$(PYTEST) $(if $(COVERAGE),--cov --cov-config=.ci/coverage.ini --cov-context=test --cov-report= \
	  --junitxml=.coverage.xml)

# Without the tests that take long or need ROS 2.
quick: $(VENV)/installed
	$(PYTEST) -m 'not slow and not ros'

# Single changes of the package, and whether tests notice: about ten seconds each.
COUNT ?= 300
SEED ?= 0
mutants: .coverage
	$(BIN)/python .ci/mutants.py --count $(COUNT) --seed $(SEED) --jobs 2

.coverage: $(shell find rangeseg_ros test -name '*.py')
	$(MAKE) test COVERAGE=1

# What every mechanism costs and what it buys, on simulated frames and those in DATA: a few minutes.
DATA ?=
ablate: $(VENV)/installed
	$(BIN)/python .ci/ablate.py $(if $(DATA),--data $(DATA)) --output docs/ledger.md

demo: $(VENV)/installed
	rm -rf demo
	$(BIN)/rangeseg simulate kinect --scenes 1 --frames 15 --seed 1 --output demo/simulated
	printf 'up_y: -0.94\nup_z: -0.34\n' > demo/up.yaml  # the camera looks down by 20 degrees
	$(BIN)/rangeseg replay demo/simulated/bag --params demo/up.yaml --output demo/planes
	@echo 'Labels, planes, a bag and report.html are in $(CURDIR)/demo/planes'

# A simulated camera at 10 Hz, the node, and a node that prints its planes, for 20 s.
demo-ros: export ROS_AUTOMATIC_DISCOVERY_RANGE = LOCALHOST
demo-ros: export FASTRTPS_DEFAULT_PROFILES_FILE = $(CURDIR)/params/fastdds_large_images.xml
demo-ros: FOR_A_WHILE = timeout --kill-after=10 20
demo-ros: $(VENV)/installed
	rm -rf demo/ros
	$(BIN)/rangeseg simulate kinect --scenes 1 --frames 60 --seed 1 --output demo/ros
	$(FOR_A_WHILE) $(BIN)/rangeseg play demo/ros/bag --rate 0.3333 --loop & \
	$(FOR_A_WHILE) $(BIN)/segment_planes --ros-args -p up_y:=-0.94 -p up_z:=-0.34 & \
	$(FOR_A_WHILE) $(BIN)/python examples/print_planes.py; \
	wait

lint: $(VENV)/linters
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The site, to open in a browser: site/index.html.
docs: $(VENV)/writers
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	! grep -rE 'src="https?:' site --include='*.html'  # nothing that is loaded from the network
	@echo 'The site is in $(CURDIR)/site'

# With the kernels compiled, for this version of Python and any processor of the kind: after pip
# install nothing is compiled.
MACHINE := $(shell uname -m)
CPU ?= $(if $(filter x86_64,$(MACHINE)),x86-64-v3,generic)
wheel: $(VENV)/installed
	rm -rf build
	$(BIN)/pip install --quiet 'setuptools>=70.1'
	RANGESEG_WHEEL=$(CPU) NUMBA_CPU_NAME=$(CPU) NUMBA_CPU_FEATURES= \
	  $(BIN)/pip wheel --no-deps --no-build-isolation --wheel-dir dist .

# Who releases it, and where: make release-names MAINTAINER='A Name' EMAIL=name@host URL=https://...
release-names: CI = $(URL)/actions/workflows/ci.yml
release-names:
	test -n '$(MAINTAINER)' -a -n '$(EMAIL)' -a -n '$(URL)'
	sed -i -e 's|<maintainer .*|<maintainer email="$(EMAIL)">$(MAINTAINER)</maintainer>|' \
	  -e '/<url /d' -e 's|.*</license>|&\n  <url type="repository">$(URL)</url>|' package.xml
	sed -i -e '/^repository-code:/d' -e 's|^license: .*|&\nrepository-code: $(URL)|' CITATION.cff
	sed -i -e '/^\[!\[CI\]/d' -e '1s|$$|\n[![CI]($(CI)/badge.svg)]($(CI))|' README.md

release-check: $(VENV)/installed
	.ci/release-check $(BIN)/python

# The messages of ROS 2 Jazzy are compiled for NumPy 1.
SYSTEM_NUMPY := $(if $(SYSTEM_ROS),'numpy<2')

# Editable, so that the sources in this folder are what runs.
$(VENV)/installed: setup.py setup.cfg pyproject.toml
	$(PYTHON) -m venv $(SYSTEM_ROS) $(VENV)
	$(BIN)/pip install --quiet --editable '.[test]' $(SYSTEM_NUMPY)
ifeq ($(SYSTEM_ROS),)
	$(BIN)/pip install --quiet --editable '.[jazzy]' || \
	  echo 'No ROS 2 wheels for this platform: the tests of the node will be skipped.'
endif
	touch $@

$(VENV)/linters: $(VENV)/installed
	$(BIN)/pip install --quiet --editable '.[lint]'
	touch $@

$(VENV)/writers: $(VENV)/installed
	$(BIN)/pip install --quiet --editable '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) .venv-oldest .venv-newest demo site build install log dist *.egg-info .coverage*
