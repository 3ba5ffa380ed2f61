# `make help` lists the targets. PYTHON may name another interpreter (3.11 or newer).
PYTHON ?= python3
VENV := .venv
LIGHT := .venv-light
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# One file of tests is one worker's: its fixtures are made once.
PYTEST := $(BIN)/python -m pytest --numprocesses logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder

# With --quiet, pip says what fails and nothing else: no notices of its own, of its settings or of setuptools.
export PIP_QUIET := 1
.SILENT: $(STAMP) demo

.PHONY: help demo quick test slow check sizes format elsewhere faults parity wheels others notebook bench report gpu pictures site app light bundle desktop clean

help:  ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

$(STAMP): pyproject.toml packaging/constraints.txt
	echo "Installing everything into $(VENV): some minutes"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --constraint packaging/constraints.txt torch
	$(BIN)/pip install --quiet --constraint packaging/constraints.txt --editable '.[dev]'
	touch $@

.PHONY: system browser
system: $(STAMP)
	@$(PYTHON) packaging/system_libraries.py

browser: $(STAMP)
	@$(PYTHON) packaging/system_libraries.py --tests

demo: system  ## install everything and open the bundled scene (without a display: a page and a picture in demo_out/)
	if [ -n "$$DISPLAY$$WAYLAND_DISPLAY" ] || [ "$$(uname)" != Linux ]; then $(BIN)/langsplat-viewer assets/demo/scene.ply; \
	else echo "No display: a page and a picture of the bundled scene instead of opening a window."; \
	  $(BIN)/langsplat demo; fi

quick: check  ## lint, types, and the tests that take no time: the loop while working
	$(PYTEST) -m "not long"

test: browser  ## install everything, then lint, type-check and run every test but the slow tier
	$(MAKE) --no-print-directory check
	$(PYTEST)

slow: system  ## the slow tier alone: fuzzing at length, large scenes, accuracy on real ones
	$(PYTEST) --dist worksteal --slow -m slow

# Prettier and eslint for the exported page's modules, installed once.
WEB := packaging/web
NPM := $(WEB)/node_modules
$(NPM)/.installed: $(WEB)/package.json $(WEB)/package-lock.json $(STAMP)
	$(BIN)/npm ci --prefix $(WEB) --silent --no-audit --no-fund
	touch $@
PRETTIER = $(BIN)/node $(NPM)/prettier/bin/prettier.cjs --config $(WEB)/.prettierrc.json --log-level warn
PAGE = langsplat_core/web/*.js $(WEB)/*.js

check: $(STAMP) $(NPM)/.installed  ## rules and format of Python and of the page's JavaScript, and mypy
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(PRETTIER) --check $(PAGE)
	$(BIN)/node $(NPM)/eslint/bin/eslint.js --config $(WEB)/eslint.config.js langsplat_core/web
	$(BIN)/codespell $$(git ls-files '*.py' '*.js' '*.glsl' '*.css' '*.html' '*.md' Makefile)
	$(BIN)/python packaging/sizes.py

sizes: $(STAMP)  ## lines of every room beside its budget (CONTRIBUTING.md)
	$(BIN)/python packaging/sizes.py

format: $(STAMP) $(NPM)/.installed  ## put every file into ruff's and prettier's format
	$(BIN)/ruff check --fix --select I
	$(BIN)/ruff format
	$(PRETTIER) --write $(PAGE)

# NEWEST: the newest Python that there are wheels of everything for; its row is left out where it is not installed.
NEWEST ?= python3.14
NEWER := .venv-newest
elsewhere: system  ## the tests that compute, as on other processors, in other orders and places (docs/benchmarks)
	if $(NEWEST) --version >/dev/null 2>&1 && ! [ -e $(NEWER)/.installed ]; then $(NEWEST) -m venv $(NEWER) \
	  && $(NEWER)/bin/pip install --quiet --constraint packaging/constraints.txt --editable '.[dev]' \
	  && touch $(NEWER)/.installed; fi
	$(BIN)/python packaging/elsewhere.py $(if $(ONLY),--only $(ONLY)) \
	  $$([ -e $(NEWER)/.installed ] && echo --newest $(NEWER)/bin/python)

faults: browser  ## small faults, put in one at a time: which of them the tests notice (half an hour)
	$(BIN)/python packaging/seeded_bugs.py $(if $(ONLY),--only "$(ONLY)")

PARITY := .parity
parity: $(STAMP)  ## vectors and masks against those of open_clip, segment_anything and sam2, in .parity (docs/encoders.md)
	SAM2_BUILD_CUDA=0 $(BIN)/pip install --quiet --upgrade --target $(PARITY) --no-deps --no-build-isolation \
	  --constraint packaging/constraints.txt $$($(BIN)/python -c "import tomllib; print(*tomllib.load(open( \
	  'pyproject.toml', 'rb'))['project']['optional-dependencies']['parity'])")
	PYTHONPATH=$(CURDIR)/$(PARITY) $(BIN)/python -m pytest --slow tests/semantics/test_parity.py

wheels: $(STAMP)  ## ask the package index for wheels of Windows and macOS, and print the table of docs/installing.md
	$(BIN)/python packaging/outside.py wheels

OTHERS := .others
others: system  ## open what is written here in other programs, kept in .others, and print the table of docs/files.md
	-$(BIN)/pip install --quiet --upgrade --target $(OTHERS) --no-deps gaussforge==0.6.0 gsply==0.4.6 trimesh==5.2.0
	-$(BIN)/npm install --prefix $(OTHERS) --silent --no-audit --no-fund \
	  @playcanvas/splat-transform@3.7.0 gltf-validator@2.0.0-dev.3.10
	PYTHONPATH=$(CURDIR)/$(OTHERS) $(BIN)/python packaging/outside.py programs

NOTEBOOK := docs/examples/06_in_a_notebook.ipynb
notebook: system  ## run the cells of docs/examples/06_in_a_notebook.ipynb again, and keep what they show
	$(BIN)/pip install --quiet --upgrade --target $(OTHERS) nbconvert==7.17.2 ipykernel==7.4.0
	PYTHONPATH=$(CURDIR)/$(OTHERS) $(BIN)/python -m nbconvert --to notebook --execute --inplace $(NOTEBOOK) \
	  --ExecutePreprocessor.record_timing=False --log-level ERROR

bench: system  ## speed against error, on this machine
	$(BIN)/langsplat bench raster --out bench_out

# Rooms are kept in eval_out: an interrupted run goes on.
FRESH := --tiers clutter --seeds 601 602 603 604 605
report: system  ## every report under docs/benchmarks, again: hours (ONLY="rooms scale": some of them)
	$(if $(ONLY),,$(BIN)/langsplat bench raster --out docs/benchmarks)
	for name in $(or $(ONLY),rooms verdicts phrases clean lifting scale); do \
	  case $$name in rooms|verdicts|phrases|clean) rooms="$(FRESH)";; *) rooms=;; esac; \
	  $(BIN)/python -m tests.benchmarks $$name $$rooms --out docs/benchmarks || exit; done

# WHEELS=folder installs from there without a network; SITE=1 keeps the packages that PYTHON has, torch among them.
# PYTHON may be that of a virtual environment: then --system-site-packages alone would not see its packages.
GPU := .venv-gpu
PURELIB := "import sysconfig; print(sysconfig.get_path('purelib'))"
gpu:  ## on a machine with CUDA: run what never ran without, write docs/benchmarks/gpu (see docs/speed.md)
	$(PYTHON) -m venv --clear $(if $(SITE),--system-site-packages) $(GPU)
	$(if $(SITE),$(PYTHON) -c $(PURELIB) > $$($(GPU)/bin/python -c $(PURELIB))/site.pth)
	$(GPU)/bin/pip install --quiet $(if $(WHEELS),--no-index --find-links $(WHEELS)) \
	  --requirement packaging/gpu/$(if $(SITE),beside_torch,requirements).txt
	MAX_JOBS=$${MAX_JOBS:-$$(nproc)} $(GPU)/bin/python packaging/gpu/run.py $(if $(ONLY),--only $(ONLY))

pictures: browser  ## make the README's pictures again (on a display, or on Xvfb)
	if [ -n "$$DISPLAY" ]; then $(BIN)/python packaging/pictures.py; \
	else xvfb-run -a -s "-screen 0 1280x800x24" $(BIN)/python packaging/pictures.py; fi

# Links to files that are no pages lose their address: there is none to give them.
SITE_AT := build/site
SITE_VENV := .venv-site
PUBLIC = $$($(BIN)/python -c "import langsplat_core; print(*langsplat_core.__all__)")
site: system  ## the pages of docs as a site, build/site/html, with the live page and the public names of Python
	[ -d $(SITE_VENV) ] || $(PYTHON) -m venv $(SITE_VENV)
	$(SITE_VENV)/bin/pip install --quiet --constraint packaging/constraints.txt mkdocs-material 'mkdocstrings[python]'
	rm -rf $(SITE_AT) && mkdir -p $(SITE_AT) && cp -r docs $(SITE_AT)/docs
	cp packaging/site/*.md $(SITE_AT)/docs && mv $(SITE_AT)/docs/README.md $(SITE_AT)/docs/pages.md
	sed 's|](docs/|](|g' README.md > $(SITE_AT)/docs/index.md
	sed -i -E 's#\[([^]]+)\]\((\.\./[^)]*|examples[^)]*|benchmarks|pictures|CONTRIBUTING\.md)\)#\1#g' $(SITE_AT)/docs/*.md
	for name in $(PUBLIC); do printf '::: langsplat_core.%s\n\n' $$name >> $(SITE_AT)/docs/api.md; done
	$(BIN)/langsplat export --quiet assets/demo/scene.ply $(SITE_AT)/docs/room.html --title "A toy table"
	$(SITE_VENV)/bin/mkdocs build --quiet --config-file packaging/site/mkdocs.yml

app: system  ## open the viewer
	$(BIN)/langsplat-viewer

light:  ## what a user without extras gets, in .venv-light: how long the installation takes, and its size
	rm -rf $(LIGHT)
	time sh -c '$(PYTHON) -m venv $(LIGHT) && $(LIGHT)/bin/pip install --quiet --constraint packaging/constraints.txt .'
	du -sm $(LIGHT)

bundle: system  ## the programs with their own Python in one folder, dist/langsplat-viewer, and try it
	$(BIN)/pip install --quiet --constraint packaging/constraints.txt --editable '.[bundle]'
	$(BIN)/pyinstaller --noconfirm --log-level ERROR --workpath dist/work packaging/bundle/langsplat-viewer.spec
	dist/langsplat-viewer/langsplat-viewer --headless --query keyboard --out dist/tried.png

DATA := $(or $(XDG_DATA_HOME),$(HOME)/.local/share)
desktop: $(STAMP)  ## show the viewer among this user's programs, and open scenes with it
	install -d $(DATA)/applications $(DATA)/icons/hicolor/256x256/apps $(DATA)/mime/packages
	sed 's|^\(Try\)\?Exec=|&$(CURDIR)/$(BIN)/|' packaging/desktop/langsplat-viewer.desktop \
	  > $(DATA)/applications/langsplat-viewer.desktop
	install -m 644 packaging/desktop/langsplat-viewer.png $(DATA)/icons/hicolor/256x256/apps/
	$(BIN)/python packaging/desktop/desktop_files.py > $(DATA)/mime/packages/langsplat-viewer.xml
	-update-mime-database $(DATA)/mime
	-update-desktop-database $(DATA)/applications

clean:  ## remove what these targets made
	rm -rf $(VENV) $(LIGHT) $(GPU) $(NEWER) $(PARITY) $(OTHERS) $(SITE_VENV) build demo_out elsewhere_out bench_out dist .pytest_cache .mypy_cache .ruff_cache $(NPM)
