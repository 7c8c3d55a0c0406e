# causticmill: `make demo` and `make test` need only Python 3.11+ and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
READY := $(VENV)/.ready
PICTURE ?= examples/camera.png
MILL := out/demo-mill.txt
TYPES := tests/page/types
TSC := $(VENV)/types/node_modules/typescript/bin/tsc

# Bytecode is always kept, despite the environment: without it each server that a test starts compiles all modules
# again (2 of 4 CPU seconds), and so does each process of pytest with all tests (24 of 36).
unexport PYTHONDONTWRITEBYTECODE

.PHONY: FORCE demo serve test test-all lint bench soak paper docs docs-pictures release format lock clean

# The locked environments, made again when a lock or the project file changes: the product's packages, then the
# developers'. By uv, in a tenth of the time that pip takes; by pip if uv or its servers are not available. Only the tests
# are compiled ahead, because all processes of pytest would compile them at once.
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet install --no-compile
UV := $(BIN)/uv --quiet pip install --python $(BIN)/python
INSTALL = $(UV) $(1) || $(PIP) $(1)
INSTALL_LOCK = $(call INSTALL,--require-hashes -r $(1))
$(INSTALLED): requirements-uv.lock requirements.lock requirements-dev.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "causticmill needs Python 3.11 or newer, this is " + sys.version.split()[0])'
	$(PYTHON) -m venv --clear $(VENV)
	-$(PIP) --require-hashes -r requirements-uv.lock
	$(call INSTALL_LOCK,requirements.lock)
	$(call INSTALL,--no-deps --no-build-isolation --editable .)
	touch $@

$(READY): $(INSTALLED)
	$(call INSTALL_LOCK,requirements-dev.lock)
	-$(BIN)/python -m pytest --collect-only -qq > /dev/null
	touch $@

# One picture through everything: planned for the usual mill and to be finished by hand; its first program to a simulated
# mill $(SPEEDUP) times as fast as a real one; and beside it what the paper's three passes leave on that mill, which are
# made again only when picture or code have changed.
SPEEDUP ?= 2000
demo: $(INSTALLED)
	@mkdir -p out; nice $(MAKE) --no-print-directory out/demo-paper/report.json & beside=$$!; \
	rm -f $(MILL); $(BIN)/causticmill sim-mill --tcp 127.0.0.1:0 --time-factor $(SPEEDUP) > $(MILL) & mill=$$!; \
	trap 'kill $$mill $$beside 2>&-; wait $$mill; tail -n 1 $(MILL)' EXIT; \
	$(BIN)/causticmill make $(PICTURE) --output out/demo --force || exit 1; \
	until port=$$(grep -o -s 'socket://[^ ]*' $(MILL)); do kill -0 $$mill || exit 1; sleep 0.1; done; \
	$(BIN)/causticmill stream out/demo/pass-1-rough.nc --port $$port --yes && \
	echo "the paper's three passes, made beside it: out/demo-paper" && wait $$beside && \
	$(BIN)/python docs/draw_result.py out/demo out/demo-paper out/demo.png && echo "both on the wall: out/demo.png"

out/demo-paper/report.json: $(INSTALLED) $(PICTURE) out/demo-paper.of $(shell find cam machines phrases optics service -name '*.py')
	@$(BIN)/causticmill make $(PICTURE) --preset paper --output out/demo-paper --force --quiet

out/demo-paper.of: FORCE
	@mkdir -p out; echo $(PICTURE) | cmp -s - $@ || echo $(PICTURE) > $@

# The job server with everything in $(DATA), and a simulated mill to try it on; Ctrl-C stops it. make serve DATA=... PORT=...
DATA ?= out/server
PORT ?= 8000
serve: $(INSTALLED)
	@exec $(BIN)/causticmill serve --data $(DATA) --port $(PORT) --with-simulated-mill

# A file of tests stays in one process, so that what its tests share is made once (tests/order.py).
PYTEST := $(BIN)/python -m pytest --numprocesses auto --dist loadfile
test: $(READY)
	$(PYTEST)

# With the thorough ones, as in .ci/run.
test-all: $(READY)
	CAUSTICMILL_SLOW=1 $(PYTEST)

# Sentences that are not translated yet are listed; only a release waits for them.
lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	@$(BIN)/python -m docs.languages
	@$(MAKE) --no-print-directory $(TSC) || true
	@if [ -f $(TSC) ]; then node $(TSC) --project $(TYPES); else echo "TypeScript could not be installed: the types of the page are not checked"; fi

# By its hash; what it checks are the comments and uses in the page's modules.
$(TSC): $(TYPES)/package-lock.json
	mkdir -p $(VENV)/types && cp $(TYPES)/package*.json $(VENV)/types
	npm ci --prefix $(VENV)/types --no-audit --no-fund --silent && touch $@

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Figures with machine and date beside them: out/bench.json and out/bench.md.
bench: $(READY)
	$(BIN)/python -m tests.benchmarks

# Writes the hashed locks anew from pyproject.toml.
LOCK_OF := $(BIN)/uv pip compile --generate-hashes --no-header --universal --python-version 3.11
LOCK := $(LOCK_OF) pyproject.toml --extra build
lock: $(INSTALLED)
	echo uv | $(LOCK_OF) - -o requirements-uv.lock
	$(LOCK) --extra dev -o requirements-dev.lock
	$(LOCK) --constraint requirements-dev.lock -o requirements.lock
	$(LOCK) --extra docs --constraint requirements-dev.lock -o requirements-docs.lock
	$(LOCK) --extra soak --constraint requirements-dev.lock -o requirements-soak.lock
	$(LOCK) --extra postgres --extra s3 --extra roland --extra mqtt --constraint requirements-dev.lock -o docker/requirements.lock

# The claims of the paper, with our pictures and figures beside them: docs/paper.md.
paper: $(READY)
	$(BIN)/python -m tests.paper

# docs/ as a site to browse, with references of commands and REST made from the code: out/docs/index.html.
docs: $(READY)
	$(call INSTALL_LOCK,requirements-docs.lock)
	$(BIN)/python -m docs.site out/docs-source
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --config-file out/docs-source/mkdocs.yml
	@! grep -rlE '<(script|link|img)[^>]+(src|href)="?https?:' out/docs --include='*.html'  # each is a page that asks the web

# The pictures of docs/: the page, by the test browser; six lenses, made into $(LENSES) where they are not there yet.
LENSES ?= out/lenses
docs-pictures: $(READY)
	$(BIN)/python -m docs.how_good $(LENSES)
	$(BIN)/python -m docs.draw_page docs/page

# What goes out, into $(RELEASE): wheel, documents, changelog, bill of materials of the lock, hashes. The wheel's files have
# the time of the commit, so that the same sources give the same bytes.
RELEASE := out/release
release: $(READY)
	$(BIN)/python -m docs.languages --strict
	@$(MAKE) --no-print-directory docs
	rm -rf $(RELEASE) build *.egg-info && mkdir -p $(RELEASE)
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir $(RELEASE) .
	rm -rf build *.egg-info
	$(BIN)/python -m docs.release $(RELEASE) out/docs
	@cat $(RELEASE)/SHA256SUMS

# Long trials (hours; `recommended` alone has 90 cases of minutes): the streamer against the simulated mill, the job
# server under kill -9, programs against their figures, simulated light against another renderer,
# programs in LinuxCNC's interpreter (apt-get install linuxcnc-uspace): out/soak.json, out/soak.md.
soak: $(READY)
	$(call INSTALL_LOCK,requirements-soak.lock)
	$(BIN)/python -m tests.trials

clean:
	rm -rf $(VENV) out build *.egg-info
