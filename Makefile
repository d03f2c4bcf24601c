# Everything a newcomer needs: `make demo` shows it, `make test` proves it.
# System packages are installed when missing (with sudo only where needed); nothing is done when present.

CARGO ?= cargo
VENV  ?= target/venv
DEMO  ?= demo

.PHONY: help setup setup-python build demo test test-python test-web test-zenoh check lint docs bench load clean deb hil hil-long hil-short hil-tools

help:
	@echo "make demo     build, simulate a flight, replay it, compare with the truth, write a report page"
	@echo "make test     every test"
	@echo "make test-web the station's page in headless Chromium (half a minute)"
	@echo "make test-zenoh the station on Zenoh, met by the Python client (builds the feature zenoh: minutes)"
	@echo "make check    format, lints, documentation, shipped configurations, licences"
	@echo "make bench    the benchmarks under benches/"
	@echo "make load     five minutes of raw frames at full pace: latency, processor time, memory, losses"
	@echo "make deb      a Debian package in target/debian"
	@echo "make hil      the virtual payload computer: install, boot, fly, compare (as root)"
	@echo "make hil-long the same with every scenario"
	@echo "make hil-short the same with cold boot, unplugged devices and landing; skips where it cannot run (a check)"

# What the build needs of the system: a C compiler for the compression libraries, CMake and an assembler
# for JPEG, and clang's library for the camera bindings.
setup:
	@sh tests/setup/packages.sh build-essential cmake nasm libclang-dev pkg-config

# What tests in other languages need: readers of our files written by other people.
setup-python: setup
	@sh tests/setup/packages.sh python3 python3-venv iproute2 nftables
	@sh tests/setup/venv.sh $(VENV) tests/python/requirements.txt

# Examples are built with the program, where they are wanted: apart, Cargo builds the library twice.
build: setup
	$(CARGO) build --release --locked $(PARTS)

demo: build
	@sh tests/demo.sh target/release/windhover $(DEMO)

test: setup-python
	$(CARGO) test --locked --workspace --no-fail-fast
	$(MAKE) test-python

# The flight file opened by readers that know nothing of us.
test-python: setup-python
	$(CARGO) build --locked
	$(VENV)/bin/python -m unittest discover -s tests/python -p 'test_*.py' -v

# The station's page in headless Chromium, fed by a running payload; pictures in target/web.
test-web: setup-python
	@sh tests/setup/packages.sh chromium
	$(CARGO) build --locked
	$(VENV)/bin/python -m unittest discover -s tests/web -p 'test_*.py' -v

# The station built with the feature `zenoh`, met by the Python client. Not part of `make test`: the feature
# adds a hundred crates to the build.
test-zenoh: setup-python
	@sh tests/setup/venv.sh $(VENV)-zenoh tests/zenoh/requirements.txt
	$(CARGO) build --locked --features zenoh
	$(VENV)-zenoh/bin/python -m unittest discover -s tests/zenoh -p 'test_*.py' -v

check: lint docs
	for file in config/*.toml; do target/debug/windhover check-config $$file > /dev/null || exit 1; done
	sh .ci/deny

lint: setup
	$(CARGO) fmt --all --check
	$(CARGO) clippy --locked --workspace --all-targets -- -D warnings

docs: setup
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --locked --workspace --no-deps --document-private-items

bench: setup
	$(CARGO) bench --locked --workspace

# Latency and load of the daemon. Figures mean something on an idle machine only; the load is printed.
load: PARTS = --bin windhover --example daemon_load
load: build
	target/release/examples/daemon_load

# The package: binary, unit, configuration, rules, manual and completions out of the command line.
deb: build
	target/release/windhover generate man target/generated/man
	target/release/windhover generate completions target/generated/completions
	test -x target/tools/bin/cargo-deb || $(CARGO) install cargo-deb --version 3.8.0 --locked --root target/tools
	target/tools/bin/cargo-deb --no-build --locked --strip

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
